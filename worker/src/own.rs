//! The worker's own configuration, as service `blaze-worker`: it has the documents, so it asks
//! nobody.
//!
//! ```text
//! engine ─▶ overlay ─▶ over the node file ─▶ judged ─▶ acknowledgement ─▶ engine, as of any service
//! ```

use std::time::Duration;

use anyhow::Context as _;
use blaze_domain::config::AckStatus;
use blaze_domain::{InstanceName, NodeName};
use blaze_runtime::config::{Overlay, Verdict};
use bytes::Bytes;
use serde_json::json;
use tokio::sync::{mpsc, watch};

use crate::core::ServedTarget;
use crate::engine::{Own, Sign};

/// Between two acknowledgements: each counts for a while.
const AGAIN: Duration = Duration::from_secs(60);

/// What BlazeConfig says of the worker, and what became of it.
pub struct OwnConfig {
    place: ServedTarget,
    overlays: watch::Receiver<Option<Overlay>>,
    ack: watch::Sender<Option<Bytes>>,
}

impl OwnConfig {
    /// Of an instance of the worker on a node; with the part of the engine, and with
    /// acknowledgements for [`say_again`].
    pub(crate) fn new(
        node: &NodeName,
        instance: InstanceName,
    ) -> anyhow::Result<(Self, Own, watch::Receiver<Option<Bytes>>)> {
        let place = ServedTarget {
            service: "blaze-worker".parse().context("the name of the program")?,
            instance: Some(instance),
            node: Some(node.clone()),
        };
        let (tell, overlays) = watch::channel(None);
        let (ack, acks) = watch::channel(None);
        let of_engine = Own { place: place.clone(), tell };
        Ok((Self { place, overlays, ack }, of_engine, acks))
    }

    /// Section `log`, over the node file.
    #[must_use]
    pub fn overlays(&self) -> watch::Receiver<Option<Overlay>> {
        self.overlays.clone()
    }

    /// Notes what became of it, with what is to be said besides.
    pub fn judged(&self, verdict: Option<&Verdict>, besides: &str) {
        let Some(verdict) = verdict else { return };
        let (status, detail) = match verdict.faults.as_deref() {
            None => (AckStatus::Applied, besides.to_owned()),
            Some(faults) => {
                let lines: Vec<String> = faults.iter().map(ToString::to_string).collect();
                (AckStatus::Rejected, lines.join("; "))
            }
        };
        let ack = json!({
            "service": self.place.service, "instance": self.place.instance, "node": self.place.node,
            "revision": verdict.overlay.revision, "hash": &*verdict.overlay.hash,
            "status": status.as_str(), "detail": detail,
        });
        self.ack.send_replace(Some(Bytes::from(ack.to_string())));
    }
}

/// Says the newest at once and again and again, until the worker ends.
pub(crate) async fn say_again(
    mut newest: watch::Receiver<Option<Bytes>>,
    signs: mpsc::Sender<Sign>,
) {
    loop {
        let ack = newest.borrow_and_update().clone();
        if let Some(ack) = ack
            && signs.send(Sign::Ack(ack)).await.is_err()
        {
            return std::future::pending().await;
        }
        if let Ok(Err(_)) = tokio::time::timeout(AGAIN, newest.changed()).await {
            return std::future::pending().await;
        }
    }
}
