//! Somebody who changes services of their own, one commit after the other, and must succeed each
//! time.

use std::collections::BTreeMap;

use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use serde_json::{Value, json};

use super::client::{Client, Must, Told};
use super::stage::micros;

/// How often a write is tried that was refused without a fault of its own: the other process was
/// first again and again.
const TRIES: usize = 20;

/// One commit, which may be tried several times.
#[derive(Clone, Copy)]
enum Write<'a> {
    Apply(&'a [(String, Value)]),
    Put(&'a str, &'a Value, Must),
    /// With the revision that it has.
    Delete(&'a str, u64),
}

/// A writer. Nobody else changes its services.
pub(crate) struct Writer {
    client: Client,
    name: String,
    documents: usize,
    padding: String,
    /// Revision of each that is there.
    there: BTreeMap<String, u64>,
    count: u64,
    random: StdRng,
}

impl Writer {
    /// Of so many services, each with so many bytes of padding.
    pub(crate) fn new(client: Client, name: &str, documents: usize, padding: usize) -> Self {
        let seed = name.bytes().fold(7, |seed: u64, byte| seed.wrapping_mul(31) + u64::from(byte));
        Self {
            client,
            name: name.to_owned(),
            documents,
            padding: "x".repeat(padding),
            there: BTreeMap::new(),
            count: 0,
            random: StdRng::seed_from_u64(seed),
        }
    }

    /// One commit: mostly one service is put, sometimes deleted, sometimes all of them are put at
    /// once. Gives its revision.
    pub(crate) async fn write(&mut self) -> u64 {
        match self.random.random_range(0..100) {
            0..2 => self.put_all().await,
            2..8 => self.delete().await,
            _ => self.put_one().await,
        }
    }

    /// All services in one commit.
    pub(crate) async fn put_all(&mut self) -> u64 {
        let config = self.config(self.documents);
        let documents: Vec<(String, Value)> =
            (0..self.documents).map(|index| (self.service(index), config.clone())).collect();
        let revision = self.insist(Write::Apply(&documents)).await;
        self.there = documents.into_iter().map(|(name, _)| (name, revision)).collect();
        revision
    }

    /// One service in one commit.
    pub(crate) async fn put_one(&mut self) -> u64 {
        let index = self.random.random_range(0..self.documents);
        let (name, config) = (self.service(index), self.config(1));
        let must =
            self.there.get(&name).map_or(Must::BeAbsent, |revision| Must::HaveRevision(*revision));
        let revision = self.insist(Write::Put(&name, &config, must)).await;
        self.there.insert(name, revision);
        revision
    }

    async fn delete(&mut self) -> u64 {
        let Some((name, seen)) = self.there.pop_first() else {
            return self.put_one().await;
        };
        self.insist(Write::Delete(&name, seen)).await
    }

    async fn insist(&self, write: Write<'_>) -> u64 {
        let mut told = self.send(write).await;
        for _ in 1..TRIES {
            match told {
                Told::No(_) => told = self.send(write).await,
                Told::Yes(_) | Told::Refused(_) | Told::Unknown(_) => break,
            }
        }
        match told {
            Told::Yes(revision) => revision,
            other => panic!("{} at {:?}: {other:?}", self.name, self.client.main),
        }
    }

    async fn send(&self, write: Write<'_>) -> Told {
        match write {
            Write::Apply(documents) => self.client.apply(documents).await,
            Write::Put(name, config, must) => self.client.put(name, config, must).await,
            Write::Delete(name, seen) => self.client.delete(name, Must::HaveRevision(seen)).await,
        }
    }

    fn service(&self, index: usize) -> String {
        format!("{}-{index}", self.name)
    }

    /// Says when it was written, and with how many others: who reads it can tell whether a commit
    /// is whole.
    fn config(&mut self, of: usize) -> Value {
        self.count += 1;
        json!({
            "batch": format!("{}-{}", self.name, self.count),
            "of": of,
            "at": micros(),
            "padding": self.padding,
        })
    }
}
