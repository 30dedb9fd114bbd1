//! `blaze dev`: main service, worker, flow and broker of one node in one process, for those who
//! develop services.
//!
//! ```text
//! REST, gRPC ─► main service ─► worker ─► broker (Redis, memory) ◄─► the service that is being developed
//!                                  └───────► flow ─► topics of the node
//! ```
//!
//! It listens on loopback alone and asks for no tokens, as `blaze-config --dev` does.

mod compose;
pub mod options;
mod redis;

use std::time::Duration;

use blaze_runtime::Supervisor;

use compose::{Dev, start};
use options::DevOptions;

use crate::config::files;
use crate::ends::Ends;
use crate::exit::{CliError, Exit};
use crate::output::{Format, print};

/// A shutdown takes at most this long.
const SHUTDOWN: Duration = Duration::from_secs(10);

/// Runs until a signal comes.
///
/// # Errors
/// [`CliError`]: bad options or files, what cannot be started, a part that failed.
pub async fn run(options: DevOptions, format: Format) -> Result<Exit, CliError> {
    // Faulty files are told before anything runs.
    let sources = match options.files.as_slice() {
        [] => Vec::new(),
        paths => files::read(paths)?,
    };
    let supervisor = Supervisor::new("dev");
    let ends = Ends::new(supervisor.clone())?;
    let outcome = tokio::select! {
        outcome = start(&options, &sources, &supervisor) => outcome,
        reason = ends.wait() => Err(CliError::Failed(reason.unwrap_or_else(|| "stopped before it \
            began".to_owned()))),
    };
    let dev = match outcome {
        Ok(dev) => dev,
        Err(error) => {
            supervisor.shutdown(Duration::from_secs(1)).await;
            return Err(error);
        }
    };
    let told = tell(&dev, &options, format);
    let reason = match &told {
        Ok(()) => ends.wait().await,
        Err(_) => None,
    };
    tokio::select! {
        () = dev.shutdown(&supervisor, SHUTDOWN) => {}
        // A second signal: at once.
        () = ends.signal() => {}
    }
    told?;
    match reason {
        None => Ok(Exit::Done),
        Some(reason) => Err(CliError::Failed(reason)),
    }
}

/// Where everything is: one line on standard output; what to try on stderr.
fn tell(dev: &Dev, options: &DevOptions, format: Format) -> Result<(), CliError> {
    let places = dev.places();
    match format {
        Format::Table => {
            let words: Vec<String> =
                places.iter().map(|(name, place)| format!("{name}={place}")).collect();
            print(&format!("ready {}", words.join(" ")))?;
            eprint!("{}", dev.to_try(options));
            Ok(())
        }
        Format::Json => {
            let members = places.into_iter().map(|(name, place)| (name.to_owned(), place.into()));
            print(&serde_json::Value::Object(members.collect()).to_string())
        }
        Format::Yaml => Err(CliError::Usage(
            "`blaze dev` says where everything is as a line or, with -o json, as an object; not as \
             YAML.".to_owned(),
        )),
    }
}
