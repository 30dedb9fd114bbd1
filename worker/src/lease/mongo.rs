//! The lease as a document of MongoDB, standalone or replica set: `leases`, one document for each
//! layer.
//!
//! Taking and renewing are one update of that document, which MongoDB does wholly or not at all.
//! Until when it is held is reckoned by the server alone (`$$NOW`), so the clocks of the workers do
//! not matter. It counts once a majority of the members has it: a primary that was replaced and
//! does not know it yet gives no lease. A new primary reckons with its own clock: as far as the
//! clocks of the members differ, the lease is shorter or longer then.

use std::time::Duration;

use async_trait::async_trait;
use blaze_domain::LayerName;
use blaze_domain::node_file::MongoSection;
use mongodb::bson::{Bson, DateTime, Document, doc};
use mongodb::options::ReturnDocument;

use super::{Held, Lease, Mark};
use crate::copy::mongo_client::{Server, is_duplicate};

/// A document of MongoDB, which names the worker while it is held.
pub struct MongoLease {
    server: Server,
    place: String,
    layer: LayerName,
    owner: String,
}

impl MongoLease {
    /// The lease of a layer, for a worker. It is connected to at the first use.
    #[must_use]
    pub fn new(section: MongoSection, layer: LayerName, owner: String) -> Self {
        let place = format!("MongoDB {}, lease {layer}", section.database);
        Self { server: Server::new(section, "lease", &place), place, layer, owner }
    }
}

#[async_trait]
impl Lease for MongoLease {
    async fn hold(&self, time: Duration, told: Option<&Mark>) -> Result<Held, String> {
        let tables = self.server.tables().await.map_err(|error| error.to_string())?;
        let id = doc! { "_id": self.layer.as_str() };
        let update = tables
            .leases
            .find_one_and_update(id, vec![taken(&self.owner, time, told)])
            .upsert(true)
            .return_document(ReturnDocument::After);
        let found = self.server.within(update).await.map_err(|error| error.to_string())?;
        match found {
            Ok(Some(found)) => Ok(Held {
                is_held: found.get_str("owner").is_ok_and(|owner| owner == self.owner),
                told: mark(&found),
                by: None,
            }),
            // Two made the document at once, and the other one was first.
            Ok(None) => Ok(Held::default()),
            Err(error) if is_duplicate(&error) => Ok(Held::default()),
            Err(error) => Err(self.server.failed(&error).to_string()),
        }
    }

    async fn release(&self) {
        let own = doc! { "_id": self.layer.as_str(), "owner": &self.owner };
        let free = doc! { "$unset": { "owner": "", "until": "" } };
        let released = match self.server.tables().await {
            Ok(tables) => self.server.limited(tables.leases.update_one(own, free)).await,
            Err(error) => Err(error),
        };
        if let Err(error) = released {
            tracing::debug!(%error, "the lease was not given up; it runs out");
        }
    }

    fn describe(&self) -> String {
        self.place.clone()
    }
}

/// What becomes of the document: it is this owner's from now on if it was or if nobody has it, else
/// it stays. Only who had it before leaves a mark: whoever takes it is to see that of the one
/// before.
fn taken(owner: &str, time: Duration, told: Option<&Mark>) -> Document {
    let time_ms = i64::try_from(time.as_millis()).unwrap_or(i64::MAX).max(1);
    let owner = doc! { "$literal": owner };
    let was_own = doc! { "$eq": ["$owner", &owner] };
    let never = Bson::DateTime(DateTime::from_millis(0));
    let is_free = doc! { "$lte": [{ "$ifNull": ["$until", never] }, "$$NOW"] };
    let is_own = doc! { "$or": [&was_own, is_free] };
    let mut set = doc! {
        "owner": { "$cond": [&is_own, owner, "$owner"] },
        "until": { "$cond": [&is_own, { "$add": ["$$NOW", time_ms] }, "$until"] },
    };
    if let Some(told) = told {
        let mark = doc! { "$literal": told.to_text() };
        set.insert("told", doc! { "$cond": [was_own, mark, "$told"] });
    }
    doc! { "$set": set }
}

fn mark(found: &Document) -> Option<Mark> {
    Mark::parse(found.get_str("told").ok()?)
}
