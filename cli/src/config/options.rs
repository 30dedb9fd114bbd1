//! Options that many commands have.

use std::path::PathBuf;

use blaze_domain::config::Key;
use clap::Args;

use super::kinds::{self, Target};
use crate::exit::CliError;

/// Which server, and as whom. No option takes a token's text: it would stand in the list of
/// processes.
#[derive(Debug, Clone, Default, Args)]
pub struct ServerOptions {
    /// Main service; else BLAZE_SERVER, else that of the context, else http://127.0.0.1:8080
    #[arg(long, value_name = "URL", help_heading = "Server")]
    pub server: Option<String>,
    /// Context, instead of the current one (see `blaze context list`)
    #[arg(long, value_name = "NAME", help_heading = "Server")]
    pub context: Option<String>,
    /// File that holds the token; else BLAZE_TOKEN_FILE, else the token in BLAZE_TOKEN, else the
    /// file of the context
    #[arg(long, value_name = "FILE", help_heading = "Server")]
    pub token_file: Option<PathBuf>,
    /// Authorities that may sign the server's certificate (PEM); else the file of the context, else
    /// those of the system
    #[arg(long, value_name = "FILE", help_heading = "Server")]
    pub ca_file: Option<PathBuf>,
    /// Certificate to show to a server that asks for one (PEM); else BLAZE_CLIENT_CERT, else that
    /// of the context
    #[arg(long, value_name = "FILE", help_heading = "Server")]
    pub client_cert: Option<PathBuf>,
    /// Its private key (PEM), where it is not in the same file; with BLAZE_CLIENT_CERT it is
    /// BLAZE_CLIENT_KEY
    #[arg(long, value_name = "FILE", requires = "client_cert", help_heading = "Server")]
    pub client_key: Option<PathBuf>,
}

impl ServerOptions {
    /// Whether the command line names a server, or how to reach one.
    #[must_use]
    pub fn is_given(&self) -> bool {
        let files = [&self.token_file, &self.ca_file, &self.client_cert, &self.client_key];
        self.server.is_some() || self.context.is_some() || files.iter().any(|file| file.is_some())
    }
}

/// One document.
#[derive(Debug, Clone, Args)]
pub struct DocumentOptions {
    /// layer, node, service, instance or rollout (ly no svc inst ro); or KIND/NAME in one
    #[arg(value_name = "KIND", value_parser = kinds::parse_target)]
    pub target: Target,
    /// Name; of an instance SERVICE/NAME
    #[arg(value_name = "NAME")]
    pub name: Option<String>,
}

impl DocumentOptions {
    /// The document that is meant.
    ///
    /// # Errors
    /// [`CliError::Usage`] without a name, or with a bad one.
    pub fn key(&self) -> Result<Key, CliError> {
        self.target.key(self.name.as_deref())
    }
}
