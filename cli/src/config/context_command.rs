//! `blaze context`.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use serde_json::{Value, json};

use super::contexts::{self, Context, Contexts, parse_name};
use super::endpoint::{parse_server, unknown_context};
use super::text::{cell, flag, list, note, print};
use crate::exit::{CliError, Exit};
use crate::output::{self, Align, Format, terminal_width};

/// Commands of `blaze context`.
#[derive(Debug, Subcommand)]
pub enum ContextCommand {
    /// Remember a server under a name; the first one becomes the current one
    Add(AddOptions),
    /// Make a context the current one
    Use(NameOptions),
    /// All contexts
    List,
    /// Forget a context; its files stay
    Remove(NameOptions),
}

/// Options of `blaze context add`.
#[derive(Debug, Args)]
pub struct AddOptions {
    /// Its name; one of that name is replaced
    #[arg(value_name = "NAME", value_parser = parse_name)]
    pub name: String,
    /// URL of the main service
    #[arg(long, value_name = "URL", value_parser = parse_url)]
    pub server: String,
    /// File that holds the token; it is read when it is needed
    #[arg(long, value_name = "FILE")]
    pub token_file: Option<PathBuf>,
    /// Authorities that may sign the server's certificate (PEM)
    #[arg(long, value_name = "FILE")]
    pub ca_file: Option<PathBuf>,
    /// Certificate to show to a server that asks for one (PEM)
    #[arg(long, value_name = "FILE")]
    pub client_cert: Option<PathBuf>,
    /// Its private key (PEM), where it is not in the same file
    #[arg(long, value_name = "FILE", requires = "client_cert")]
    pub client_key: Option<PathBuf>,
}

/// One context.
#[derive(Debug, Args)]
pub struct NameOptions {
    /// Its name
    #[arg(value_name = "NAME", value_parser = parse_name)]
    pub name: String,
}

fn parse_url(text: &str) -> Result<String, String> {
    Ok(parse_server(text)?.as_str().trim_end_matches('/').to_owned())
}

/// Runs one of them.
///
/// # Errors
/// [`CliError`].
pub(super) fn run(command: &ContextCommand, format: Format) -> Result<Exit, CliError> {
    let file = contexts::default_file().ok_or_else(|| {
        CliError::Failed("neither XDG_CONFIG_HOME nor HOME says where contexts are kept".to_owned())
    })?;
    run_with(command, &file, format)
}

fn run_with(command: &ContextCommand, file: &Path, format: Format) -> Result<Exit, CliError> {
    match command {
        ContextCommand::Add(options) => {
            let files =
                [&options.token_file, &options.ca_file, &options.client_cert, &options.client_key];
            for given in files.into_iter().flatten().filter(|file| !file.exists()) {
                note(format, &format!("{} does not exist yet", given.display()));
            }
            let context = Context {
                server: options.server.clone(),
                token_file: options.token_file.as_deref().map(absolute).transpose()?,
                ca_file: options.ca_file.as_deref().map(absolute).transpose()?,
                client_cert: options.client_cert.as_deref().map(absolute).transpose()?,
                client_key: options.client_key.as_deref().map(absolute).transpose()?,
            };
            let known = contexts::update(file, |known| {
                known.contexts.insert(options.name.clone(), context);
                known.current.get_or_insert_with(|| options.name.clone());
                Ok(known.clone())
            })?;
            told(&known, &options.name, "is kept", format)
        }
        ContextCommand::Use(options) => {
            let known = contexts::update(file, |known| {
                must_exist(known, &options.name)?;
                known.current = Some(options.name.clone());
                Ok(known.clone())
            })?;
            told(&known, &options.name, "is the current one", format)
        }
        ContextCommand::Remove(options) => {
            let known = contexts::update(file, |known| {
                must_exist(known, &options.name)?;
                known.contexts.remove(&options.name);
                known.current.take_if(|current| *current == options.name);
                Ok(known.clone())
            })?;
            told(&known, &options.name, "is forgotten", format)
        }
        ContextCommand::List => {
            let known = contexts::load(file)?;
            if known.contexts.is_empty() {
                note(
                    format,
                    "there are no contexts: `blaze context add NAME --server URL` makes one",
                );
            }
            print(&listed(&known), format, table)
        }
    }
}

/// Paths are kept as they are from everywhere.
fn absolute(path: &Path) -> Result<PathBuf, CliError> {
    std::path::absolute(path)
        .map_err(|error| CliError::Failed(format!("{}: {error}", path.display())))
}

fn must_exist(known: &Contexts, name: &str) -> Result<(), CliError> {
    if known.contexts.contains_key(name) {
        Ok(())
    } else {
        Err(CliError::Usage(unknown_context(name, known.contexts.keys())))
    }
}

fn told(known: &Contexts, name: &str, what: &str, format: Format) -> Result<Exit, CliError> {
    print(&listed(known), format, |_| {
        let current = known.current.as_deref().unwrap_or("none");
        format!("{name} {what}; current: {current}")
    })
}

fn listed(known: &Contexts) -> Value {
    let items: Vec<Value> = known
        .contexts
        .iter()
        .map(|(name, context)| {
            json!({
                "name": name, "current": known.current.as_deref() == Some(name),
                "server": context.server,
                "token_file": context.token_file, "ca_file": context.ca_file,
                "client_cert": context.client_cert, "client_key": context.client_key,
            })
        })
        .collect();
    json!({ "items": items })
}

fn table(listed: &Value) -> String {
    let contexts = list(listed, "items");
    if contexts.is_empty() {
        return String::new();
    }
    output::table(
        contexts,
        terminal_width(),
        &[
            ("NAME", Align::Left, &|context| cell(context.get("name"))),
            ("CURRENT", Align::Left, &|context| {
                (if flag(context, "current") { "*" } else { "" }).to_owned()
            }),
            ("SERVER", Align::Left, &|context| cell(context.get("server"))),
            ("TOKEN FILE", Align::Left, &|context| cell(context.get("token_file"))),
            ("AUTHORITIES", Align::Left, &|context| cell(context.get("ca_file"))),
            ("CLIENT CERTIFICATE", Align::Left, &|context| cell(context.get("client_cert"))),
        ],
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn add(name: &str) -> ContextCommand {
        ContextCommand::Add(AddOptions {
            name: name.to_owned(),
            server: format!("https://{name}.example"),
            token_file: Some(PathBuf::from("token")),
            ca_file: None,
            client_cert: Some(PathBuf::from("client.pem")),
            client_key: None,
        })
    }

    fn named(name: &str) -> NameOptions {
        NameOptions { name: name.to_owned() }
    }

    #[test]
    fn contexts_come_and_go() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("config.yaml");
        let run = |command: &ContextCommand| run_with(command, &file, Format::Json);
        run(&add("lab")).unwrap();
        run(&add("hall")).unwrap();
        let current = || contexts::load(&file).unwrap().current;
        assert_eq!(current().as_deref(), Some("lab"));
        run(&ContextCommand::Use(named("hall"))).unwrap();
        assert_eq!(current().as_deref(), Some("hall"));
        let kept = contexts::load(&file).unwrap();
        assert!(kept.contexts["lab"].token_file.as_ref().unwrap().is_absolute());
        assert!(kept.contexts["lab"].client_cert.as_ref().unwrap().is_absolute());
        assert!(
            table(&listed(&kept)).contains("hall  *        https://hall.example"),
            "{}",
            table(&listed(&kept))
        );
        let error = run(&ContextCommand::Use(named("labb"))).unwrap_err();
        assert!(error.to_string().contains("did you mean lab?\n  `blaze context list`"), "{error}");
        let error = run(&ContextCommand::Use(named("zebra"))).unwrap_err();
        assert!(error.to_string().starts_with("there is no context zebra\n  `blaze"), "{error}");
        run(&ContextCommand::Remove(named("hall"))).unwrap();
        assert_eq!(current(), None);
        assert_eq!(contexts::load(&file).unwrap().contexts.len(), 1);
        run(&ContextCommand::List).unwrap();
    }

    #[test]
    fn urls_are_kept_short() {
        assert_eq!(parse_url("https://lab.example:8443/").unwrap(), "https://lab.example:8443");
        assert!(parse_url("lab.example").is_err());
    }
}
