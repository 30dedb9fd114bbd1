//! Faults inside RustDDS on demand. Its event loop calls the wakers of readers, so a waker can end
//! or block it.

use std::sync::Arc;
use std::task::{Wake, Waker};
use std::thread;
use std::time::Duration;

use super::farewell::Farewell;
use super::{DdsError, GuidPrefix, Participant, Profile, create_error};

/// What is to go wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// The event loop panics and unwinds.
    Panic,
    /// The event loop stands still for a minute.
    Hang,
    /// A good-bye comes that another participant did not say.
    GoodBye(GuidPrefix),
}

struct Trap(Fault);

impl Wake for Trap {
    #[allow(clippy::panic, reason = "the panic is what the caller asked for")]
    fn wake(self: Arc<Self>) {
        match self.0 {
            Fault::Panic => panic!("injected into the event loop"),
            Fault::Hang => thread::sleep(Duration::from_secs(60)),
            Fault::GoodBye(_) => {}
        }
    }
}

pub(super) fn inject(participant: &Participant, fault: Fault) -> Result<(), DdsError> {
    if let Fault::GoodBye(whose) = fault {
        let said = Farewell::new(participant.address(), participant.port())
            .and_then(|mut farewell| farewell.say(whose));
        return said.map_err(create_error("socket"));
    }
    let topic = format!("blaze/fault/{}", participant.prefix());
    let profile = Profile::best_effort(1);
    let reader = participant.raw_reader((&topic, super::FRAME_TYPE), profile)?;
    reader.set_waker(Some(Waker::from(Arc::new(Trap(fault)))));
    let writer = participant.writer(&topic, profile)?;
    for _ in 0..200 {
        if writer.write(b"!") {
            break;
        }
        thread::sleep(Duration::from_millis(10));
    }
    // Both stay until the event loop has met the waker; a dead or hanging loop never hears of their
    // end anyway.
    thread::sleep(Duration::from_millis(50));
    Ok(())
}
