//! Reads that see every write that was acknowledged before them, through whichever process.
//!
//! All who wait share one look at the store's newest revision. Who comes while a look is under way
//! waits for the next one: the one under way may be older than a write that was acknowledged just
//! before.

use tokio::sync::{mpsc, oneshot};

use blaze_domain::config::{Code, Problem};

/// Readers that may wait, at most.
const MAX_WAITING: usize = 65_536;

type Waiter = oneshot::Sender<Result<u64, Problem>>;

/// Where readers wait.
#[derive(Clone)]
pub(crate) struct Barrier {
    queue: mpsc::Sender<Waiter>,
}

/// The other end: who looks.
pub(crate) struct Looks {
    queue: mpsc::Receiver<Waiter>,
}

/// Both ends.
pub(crate) fn barrier() -> (Barrier, Looks) {
    let (sender, receiver) = mpsc::channel(MAX_WAITING);
    (Barrier { queue: sender }, Looks { queue: receiver })
}

impl Barrier {
    /// A revision that is at least that of every write acknowledged before this call.
    pub(crate) async fn revision(&self) -> Result<u64, Problem> {
        let (sender, receiver) = oneshot::channel();
        self.queue.try_send(sender).map_err(|_| {
            Problem::new(Code::Overloaded, "too many reads wait for the store; try again")
                .retry_after(1)
        })?;
        let ended = || {
            Problem::new(Code::ShuttingDown, "the service is ending; try again elsewhere")
                .retry_after(1)
        };
        receiver.await.map_err(|_| ended())?
    }
}

impl Looks {
    /// All who wait now; waits for the first.
    pub(crate) async fn next(&mut self) -> Option<Vec<Waiter>> {
        let mut out = vec![self.queue.recv().await?];
        while let Ok(waiter) = self.queue.try_recv() {
            out.push(waiter);
        }
        Some(out)
    }

    /// Answers them.
    pub(crate) fn answer(waiters: Vec<Waiter>, result: &Result<u64, Problem>) {
        for waiter in waiters {
            // Who has gone needs no answer.
            let _ = waiter.send(result.clone());
        }
    }
}
