//! The servers that are measured, started for this run alone, and what they use.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use anyhow::Context as _;
use blaze_auth::{Algorithm, NewToken, Realm, generate_key, random_id, sign_locally};
use blaze_tests::admin::Admin;
use blaze_tests::process::{Process, cpu_time};
use blaze_tests::servers::{EtcdOptions, EtcdServer, MongoOptions, MongoServer, mongo_command};
use serde_json::{Value, json};
use tokio::task::block_in_place;
use tokio::time::sleep_until;

use super::clients::Way;
use super::closed;
use super::documents::Documents;
use super::figures::Window;
use super::load::APPLIED;

/// A start on a machine that does much else; measured below a second.
const START: Duration = Duration::from_secs(60);
/// etcd refuses writes above 2 GiB by default, which a long run may reach: nothing is compacted, as
/// nothing is trimmed.
const ETCD_BYTES: &str = "--quota-backend-bytes=34359738368";

/// Where BlazeConfig keeps documents.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Store {
    Mongo,
    Sqlite,
}

impl Store {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Mongo => "mongodb",
            Self::Sqlite => "sqlite",
        }
    }
}

/// A running server with its documents.
pub(crate) struct Subject {
    pub(crate) name: String,
    pub(crate) documents: Arc<Documents>,
    server: Server,
}

enum Server {
    Etcd(EtcdServer),
    Blaze(Box<Blaze>),
}

/// A main service, and the database behind it.
struct Blaze {
    store: Store,
    process: Process,
    /// Does nothing, but might.
    _second: Option<Process>,
    mongo: Option<MongoServer>,
    rest: SocketAddr,
    grpc: SocketAddr,
    admin: Admin,
    token: String,
}

/// All that run.
pub(crate) struct Subjects(Vec<Subject>);

/// What was used between two looks.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Used {
    pub(crate) server: Duration,
    pub(crate) database: Option<Duration>,
    /// This program.
    pub(crate) client: Duration,
    /// Revisions, and transactions that wrote them.
    written: Option<(f64, f64)>,
    pub(crate) aborts: Option<i64>,
}

impl Used {
    /// Adds what was used at another time.
    pub(crate) fn add(&mut self, other: Self) {
        self.server += other.server;
        self.database = sum(self.database, other.database, |one, other| one + other);
        self.client += other.client;
        self.written =
            sum(self.written, other.written, |one, other| (one.0 + other.0, one.1 + other.1));
        self.aborts = sum(self.aborts, other.aborts, |one, other| one + other);
    }

    /// Requests in one transaction, in the mean.
    pub(crate) fn batch(&self) -> Option<f64> {
        let (revisions, transactions) = self.written?;
        (transactions > 0.0).then_some(revisions / transactions)
    }
}

fn sum<T>(one: Option<T>, other: Option<T>, add: fn(T, T) -> T) -> Option<T> {
    match (one, other) {
        (Some(one), Some(other)) => Some(add(one, other)),
        (one, other) => one.or(other),
    }
}

/// Counters since the start.
struct Sample {
    server: Duration,
    database: Option<Duration>,
    client: Duration,
    written: Option<(f64, f64)>,
    aborts: Option<i64>,
}

impl Subjects {
    /// Starts etcd and a main service on each store, all with data in one folder; on MongoDB a
    /// second one if that is wanted.
    ///
    /// # Errors
    /// When one is not there or does not start.
    pub(crate) fn start(
        folder: &Path,
        stores: &[Store],
        documents: u64,
        second: bool,
    ) -> anyhow::Result<Self> {
        let etcd = EtcdServer::start(EtcdOptions {
            folder: Some(folder.to_owned()),
            extra: vec![ETCD_BYTES.to_owned()],
        })?;
        let mut all = vec![Subject::new("etcd", documents, Server::Etcd(etcd))];
        for store in stores {
            let blaze = Blaze::start(folder, *store, second && *store == Store::Mongo)?;
            let name = format!("blaze {}", store.name());
            all.push(Subject::new(&name, documents, Server::Blaze(Box::new(blaze))));
        }
        Ok(Self(all))
    }

    pub(crate) fn all(&self) -> &[Subject] {
        &self.0
    }

    pub(crate) fn etcd(&self) -> &Subject {
        // The first one, from the start.
        &self.0[0]
    }

    /// The main service on a store.
    ///
    /// # Errors
    /// When it was not started.
    pub(crate) fn of(&self, store: Store) -> anyhow::Result<&Subject> {
        let is_it = |subject: &&Subject| {
            matches!(
                &subject.server,
                Server::Blaze(blaze) if blaze.store == store,
            )
        };
        self.0.iter().find(is_it).with_context(|| format!("no {}", store.name()))
    }
}

impl Subject {
    fn new(name: &str, documents: u64, server: Server) -> Self {
        Self { name: name.to_owned(), documents: Arc::new(Documents::new(documents)), server }
    }

    /// How it is reached; etcd has no REST.
    pub(crate) fn way(&self, rest: bool) -> Way {
        match &self.server {
            Server::Etcd(etcd) => Way::Etcd(etcd.address()),
            Server::Blaze(blaze) if rest => {
                Way::Rest { at: blaze.rest, token: blaze.token.clone() }
            }
            Server::Blaze(blaze) => Way::Grpc { at: blaze.grpc, token: blaze.token.clone() },
        }
    }

    /// Makes all documents.
    ///
    /// # Errors
    /// When it refuses.
    pub(crate) async fn fill(&self) -> anyhow::Result<()> {
        let mut connection = self.way(false).connect().await?;
        let all: Vec<usize> = (0..self.documents.count()).collect();
        for numbers in all.chunks(APPLIED) {
            let made = closed::apply(&mut connection, &self.documents, numbers).await;
            made.with_context(|| format!("filling {}", self.name))?;
        }
        Ok(())
    }

    /// Resident memory in KiB: of the server, and of its database.
    ///
    /// # Errors
    /// When it has ended.
    pub(crate) fn resident_kib(&self) -> anyhow::Result<(u64, Option<u64>)> {
        match &self.server {
            Server::Etcd(etcd) => Ok((etcd.rss_kib()?, None)),
            Server::Blaze(blaze) => {
                let own = blaze.process.resident_bytes().context("blaze-config has ended")? / 1024;
                Ok((own, blaze.mongo.as_ref().map(MongoServer::rss_kib).transpose()?))
            }
        }
    }

    /// Waits for the window to pass, and gives what was used in it.
    ///
    /// # Errors
    /// When a process has ended.
    pub(crate) async fn used_in(&self, window: Window) -> anyhow::Result<Used> {
        sleep_until(window.begin.into()).await;
        let before = block_in_place(|| self.sample())?;
        sleep_until(window.end.into()).await;
        let after = block_in_place(|| self.sample())?;
        let between = |before: Option<Duration>, after: Option<Duration>| {
            Some(after?.saturating_sub(before?))
        };
        let written = match (before.written, after.written) {
            (Some(before), Some(after)) => Some((after.0 - before.0, after.1 - before.1)),
            _ => None,
        };
        Ok(Used {
            server: after.server.saturating_sub(before.server),
            database: between(before.database, after.database),
            client: after.client.saturating_sub(before.client),
            written,
            aborts: before.aborts.zip(after.aborts).map(|(before, after)| after - before),
        })
    }

    /// Times first: the counters are asked over the network.
    fn sample(&self) -> anyhow::Result<Sample> {
        let client = cpu_time(std::process::id())?;
        match &self.server {
            Server::Etcd(etcd) => Ok(Sample {
                server: cpu_time(etcd.pid().context("etcd has ended")?)?,
                database: None,
                client,
                written: None,
                aborts: None,
            }),
            Server::Blaze(blaze) => {
                let server = cpu_time(blaze.process.id())?;
                let mongo = blaze.mongo.as_ref();
                let database =
                    mongo.map(|mongo| cpu_time(mongo.pid().context("mongod has ended")?));
                Ok(Sample {
                    server,
                    database: database.transpose()?,
                    client,
                    written: Some(blaze.written()?),
                    aborts: mongo.map(aborted).transpose()?,
                })
            }
        }
    }
}

/// Transactions that MongoDB undid since its start.
fn aborted(mongo: &MongoServer) -> anyhow::Result<i64> {
    let status = mongo_command(
        &mongo.uri(),
        "admin",
        &json!({ "serverStatus": 1, "repl": 0, "metrics": 0 }),
    )?;
    let transactions = status.get_document("transactions")?;
    Ok(transactions.get_i64("totalAborted")?)
}

impl Blaze {
    /// With a token needed and everything else as it is by default.
    fn start(folder: &Path, store: Store, second: bool) -> anyhow::Result<Self> {
        let folder = folder.join(store.name());
        std::fs::create_dir(&folder)?;
        let mongo = match store {
            Store::Mongo => Some(MongoServer::start(MongoOptions {
                folder: Some(folder.clone()),
                ..MongoOptions::default()
            })?),
            Store::Sqlite => None,
        };
        let store_section = match &mongo {
            Some(mongo) => json!({ "mongodb": { "uri": mongo.uri(), "database": "bench" } }),
            None => json!({ "sqlite": { "path": folder.join("config.db") } }),
        };
        let key = generate_key(Algorithm::Hs256).map_err(anyhow::Error::msg)?;
        let key = key.private.trim_end();
        let key_file = folder.join("jwt.key");
        std::fs::write(&key_file, key)?;
        let node_file = write_node_file(&folder, &key_file, &store_section)?;
        let token = token(key.as_bytes())?;

        let arguments = ["--config", node_file.to_str().context("the folder has a name in UTF-8")?];
        let start = || {
            let process = Process::start("blaze-config", &arguments, None)?;
            process.ready_at("admin", START)?;
            anyhow::Ok(process)
        };
        let (process, second) = (start()?, second.then(start).transpose()?);
        let at = |name| process.ready_at(name, START);
        Ok(Self {
            store,
            rest: at("rest")?,
            grpc: at("grpc")?,
            admin: Admin { address: at("admin")?, namespace: None },
            process,
            _second: second,
            mongo,
            token,
        })
    }

    /// Revisions, and transactions, since its start.
    fn written(&self) -> anyhow::Result<(f64, f64)> {
        let metric =
            |name: &str| self.admin.metric(name, &[]).with_context(|| format!("no metric {name}"));
        Ok((
            metric("blaze_config_revision")?,
            metric("blaze_config_commit_duration_seconds_count")?,
        ))
    }
}

/// JSON is YAML.
fn write_node_file(folder: &Path, key_file: &Path, store: &Value) -> anyhow::Result<PathBuf> {
    let path = folder.join("node.yaml");
    let file = json!({
        "log": { "level": "warn" },
        "control_plane": {
            "rest": { "listen": "127.0.0.1:0" },
            "grpc": { "listen": "127.0.0.1:0" },
            "admin": { "listen": "127.0.0.1:0" },
            "store": store,
            "auth": { "keys": [{ "id": "k1", "alg": "HS256", "file": key_file, "sign": true }] },
        },
    });
    std::fs::write(&path, serde_json::to_string_pretty(&file)?)?;
    Ok(path)
}

fn token(key: &[u8]) -> anyhow::Result<String> {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH)?.as_secs();
    let issued_s = i64::try_from(now)?;
    let (roles, id) = (["operator".to_owned()], random_id().map_err(anyhow::Error::msg)?);
    let token = NewToken {
        subject: "bench",
        roles: &roles,
        layer: None,
        issued_s,
        expires_s: issued_s + 86_400,
        id: &id,
    };
    let signed = sign_locally(&Realm::default(), key, Algorithm::Hs256, Some("k1"), &token);
    signed.map_err(anyhow::Error::msg)
}
