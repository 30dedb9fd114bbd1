//! The configuration of a program that has a node file: what a worker says counts over the file.
//!
//! ```text
//! worker ─► ConfigManager ─► Overlay (sections of the node file) ─► blaze_runtime::config::watch_with ─► the program
//!    ▲                                                                                     │ judged
//!    └── blaze/config/ack: applied once; rejected again and again ◄─ acknowledging task ◄──┘
//! ```

use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::PublishOutcome;
use blaze_domain::config::spec::NODE_FILE_SECTIONS;
use blaze_runtime::config::{Overlay, Verdict};
use blaze_runtime::{Supervisor, TaskPolicy};
use serde_json::{Map, Value};
use tokio::sync::watch;

use super::{AckStatus, ConfigManager, Shown};

/// As faults name it.
const ORIGIN: &str = "BlazeConfig";
/// An acknowledgement that the broker did not take is tried again after this time.
const RETRY: Duration = Duration::from_secs(1);
/// A rejection is said again after this time: it may have been missed, and a roll-out is judged by
/// it.
const AGAIN: Duration = Duration::from_secs(5);
/// Faults that an acknowledgement names, at most.
const MAX_FAULTS: usize = 5;

/// The configuration of a program that has a node file. Ends with the service that it is of.
#[derive(Clone)]
pub struct ProgramConfig {
    overlays: watch::Receiver<Option<Overlay>>,
    said: watch::Sender<Option<Said>>,
}

/// What is said of a configuration.
#[derive(Debug, Clone, PartialEq)]
struct Said {
    revision: u64,
    hash: Arc<str>,
    status: AckStatus,
    detail: String,
}

impl ProgramConfig {
    pub(crate) fn start(config: &ConfigManager, supervisor: &Supervisor) -> Self {
        let (tell, overlays) = watch::channel(None);
        let (said, saying) = watch::channel(None);
        let shown = config.shown();
        let stop = supervisor.shutdown_token();
        let speaker = config.clone();
        supervisor.spawn("program configuration", TaskPolicy::MayEnd, async move {
            tokio::select! {
                () = stop.cancelled() => {}
                ((), ()) =
                    async { tokio::join!(lay_over(shown, tell), acknowledge(&speaker, saying)) } => {}
            }
        });
        Self { overlays, said }
    }

    /// The sections of the node file that a worker gives, for
    /// [`blaze_runtime::config::watch_with`]; other members are left out. `None`: no worker gave
    /// any yet, or the service was deleted.
    #[must_use]
    pub fn overlays(&self) -> watch::Receiver<Option<Overlay>> {
        self.overlays.clone()
    }

    /// Acknowledges what became of a configuration: `applied`, with what is to be said besides, or
    /// `rejected` with its faults.
    pub fn judged(&self, verdict: Option<&Verdict>, besides: &str) {
        self.said.send_replace(verdict.map(|verdict| said(verdict, besides)));
    }
}

fn said(verdict: &Verdict, besides: &str) -> Said {
    let (status, detail) = match &verdict.faults {
        None => (AckStatus::Applied, besides.to_owned()),
        Some(faults) => {
            let lines: Vec<String> =
                faults.iter().take(MAX_FAULTS).map(ToString::to_string).collect();
            (AckStatus::Rejected, lines.join("; "))
        }
    };
    Said {
        revision: verdict.overlay.revision,
        hash: Arc::clone(&verdict.overlay.hash),
        status,
        detail,
    }
}

/// Tells of each other configuration until the service ends.
async fn lay_over(mut shown: watch::Receiver<Shown>, tell: watch::Sender<Option<Overlay>>) {
    loop {
        let overlay = overlay(&shown.borrow_and_update());
        tell.send_if_modified(|before| {
            // The revision goes on with the store, also where nothing changes here.
            let hash = |overlay: &Option<Overlay>| {
                overlay.as_ref().map(|overlay| Arc::clone(&overlay.hash))
            };
            let is_other = hash(before) != hash(&overlay);
            if is_other {
                *before = overlay;
            }
            is_other
        });
        if shown.changed().await.is_err() {
            return;
        }
    }
}

fn overlay(shown: &Shown) -> Option<Overlay> {
    let held = shown.held()?;
    let members = held.config.as_object().into_iter().flatten();
    let sections = members.filter(|(name, _)| NODE_FILE_SECTIONS.contains(&name.as_str()));
    let tree: Map<String, Value> =
        sections.map(|(name, value)| (name.clone(), value.clone())).collect();
    Some(Overlay {
        origin: Arc::from(ORIGIN),
        revision: held.revision,
        hash: Arc::from(held.hash.as_str()),
        tree: Arc::new(Value::Object(tree)),
    })
}

/// Says the newest until the broker has taken it, and a rejection again and again.
async fn acknowledge(config: &ConfigManager, mut saying: watch::Receiver<Option<Said>>) {
    loop {
        let said = saying.borrow_and_update().clone();
        let again = match &said {
            Some(said) => {
                match config.ack_of(Some((said.revision, &said.hash)), said.status, &said.detail) {
                    Ok(PublishOutcome::Taken) if said.status == AckStatus::Rejected => Some(AGAIN),
                    Ok(PublishOutcome::Taken) => None,
                    Ok(_) => Some(RETRY),
                    Err(error) => {
                        tracing::debug!(%error, "a configuration could not be acknowledged");
                        None
                    }
                }
            }
            None => None,
        };
        let wait = async {
            match again {
                Some(pause) => tokio::time::sleep(pause).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            changed = saying.changed() => {
                if changed.is_err() {
                    return;
                }
            }
            () = wait => {}
        }
    }
}
