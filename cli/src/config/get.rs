//! `blaze get`.

use blaze_domain::config::{Key, Kind};
use blaze_domain::{LayerName, NodeName, ServiceName};
use clap::Args;
use serde_json::Value;

use super::api::{Filter, Listing, clean};
use super::client::Client;
use super::kinds::{key_of, name_of};
use super::options::{DocumentOptions, ServerOptions};
use super::tables::{self, Layout};
use super::text::{count, json_line, now_ms, print};
use super::watch::{self, Scope};
use super::yaml;
use crate::exit::{CliError, Exit};
use crate::output::{self, Format, Output, terminal_width};

/// Options of `blaze get`.
#[derive(Debug, Args)]
pub struct GetOptions {
    /// Which documents.
    #[command(flatten)]
    pub document: DocumentOptions,
    /// Only those whose labels match, for example 'site=lab,canary' or 'tier in (a,b),!old'
    #[arg(short = 'l', long, value_name = "SELECTOR")]
    pub selector: Option<String>,
    /// Only what is in this layer
    #[arg(long, value_name = "LAYER")]
    pub layer: Option<LayerName>,
    /// Only what is on this node
    #[arg(long, value_name = "NODE")]
    pub node: Option<NodeName>,
    /// Only instances of this service
    #[arg(long, value_name = "SERVICE")]
    pub service: Option<ServiceName>,
    /// At most so many; without it all
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub limit: Option<u64>,
    /// The document as it was at this revision
    #[arg(long, value_name = "R", value_parser = clap::value_parser!(u64).range(1..))]
    pub revision: Option<u64>,
    /// Without the members that the server sets: what can be applied again
    #[arg(long)]
    pub clean: bool,
    /// With the text of secrets, with -o json or yaml; needs the role admin, and is written down
    #[arg(long)]
    pub reveal: bool,
    /// Then show every change as it happens
    #[arg(short, long)]
    pub watch: bool,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

impl GetOptions {
    fn check(&self, key: Option<&Key>, output: Output) -> Result<(), CliError> {
        let usage = |text: &str| Err(CliError::Usage(text.to_owned()));
        let kind = self.document.target.kind;
        if key.is_some() && (self.is_filtered() || self.limit.is_some()) {
            return usage("a name and a filter: give one of them");
        }
        if self.service.is_some() && kind != Kind::Instance {
            return usage("--service is for instances: `blaze get instances --service NAME`");
        }
        if self.revision.is_some() && key.is_none() {
            return usage("--revision shows one document as it was: give its name");
        }
        if self.watch && (self.limit.is_some() || self.revision.is_some() || output == Output::Name)
        {
            return usage("--watch goes with neither --limit nor --revision nor -o name");
        }
        if self.reveal && !matches!(output, Output::Json | Output::Yaml) {
            return usage(
                "--reveal shows secrets where they stand in documents: give -o json or -o yaml",
            );
        }
        if self.reveal && self.watch {
            return usage(
                "changes come without the text of secrets: --reveal goes without --watch",
            );
        }
        if self.watch && self.node.is_some() {
            return usage("changes cannot be watched by node; --layer and -l can");
        }
        Ok(())
    }

    /// Whether only some of what there is is asked for.
    fn is_filtered(&self) -> bool {
        self.selector.is_some()
            || self.layer.is_some()
            || self.node.is_some()
            || self.service.is_some()
    }

    fn filter(&self) -> Filter {
        Filter {
            service: self.service.clone(),
            selector: self.selector.clone(),
            layer: self.layer.clone(),
            node: self.node.clone(),
            limit: self.limit,
            reveal: self.reveal,
        }
    }
}

/// Gets.
///
/// # Errors
/// [`CliError`].
pub(super) async fn run(options: &GetOptions, output: Output) -> Result<Exit, CliError> {
    let key = options.document.target.optional_key(options.document.name.as_deref())?;
    options.check(key.as_ref(), output)?;
    let client = Client::of(&options.server)?;
    let kind = options.document.target.kind;
    // What follows the first list has no more columns, and no names alone.
    let format = match output {
        Output::Table | Output::Wide | Output::Name => Format::Table,
        Output::Json => Format::Json,
        Output::Yaml => Format::Yaml,
    };
    let since = match &key {
        Some(key) => {
            let answer = client.read_document(key, options.revision, options.reveal).await?;
            let document = if options.clean { clean(answer.body) } else { answer.body };
            match format {
                Format::Table => show_rows(kind, std::slice::from_ref(&document), output)?,
                Format::Json | Format::Yaml => show_value(&document, format, options.watch)?,
            }
            answer.revision
        }
        None => {
            let mut listing = client.list(kind, &options.filter()).await?;
            if options.clean {
                listing.items = listing.items.into_iter().map(clean).collect();
            }
            let revision = listing.revision;
            match format {
                Format::Table => show_listing(kind, &listing, output, options.is_filtered())?,
                Format::Json | Format::Yaml => {
                    show_value(&listing.into_json(), format, options.watch)?;
                }
            }
            revision
        }
    };
    if !options.watch {
        return Ok(Exit::Done);
    }
    let scope = Scope {
        kind: Some(kind),
        key,
        service: options.service.clone(),
        layer: options.layer.clone(),
        selector: options.selector.clone(),
    };
    watch::until_interrupted(&client, &scope, since, format, false).await
}

/// With `line`, JSON stands on one line, because events follow, one a line.
fn show_value(value: &Value, format: Format, line: bool) -> Result<(), CliError> {
    match (format, line) {
        (Format::Json, true) => output::print(&json_line(value)?),
        (Format::Yaml, true) => output::print(&yaml::documents([value])),
        _ => print(value, format, |_| String::new()).map(drop),
    }
}

fn show_listing(
    kind: Kind,
    listing: &Listing,
    output: Output,
    is_filtered: bool,
) -> Result<(), CliError> {
    if listing.is_cut() {
        let first = count(listing.items.len(), kind.word());
        eprintln!("blaze: these are the first {first}; there are more");
    }
    if listing.items.is_empty() && output != Output::Name && is_filtered {
        eprintln!("blaze: no {} match", kind.collection());
        return Ok(());
    }
    show_rows(kind, &listing.items, output)
}

fn show_rows(kind: Kind, items: &[Value], output: Output) -> Result<(), CliError> {
    if output == Output::Name {
        let text = names(items);
        return if text.is_empty() { Ok(()) } else { output::print(&text) };
    }
    if items.is_empty() {
        eprintln!("blaze: there are no {}", kind.collection());
        return Ok(());
    }
    let layout = Layout { wide: output == Output::Wide, width: terminal_width(), now_ms: now_ms() };
    output::print(&tables::documents(kind, items, layout))
}

/// `node/robot-1`, one a line; what is no document is left out.
fn names(items: &[Value]) -> String {
    let mut text = String::new();
    for key in items.iter().filter_map(|item| key_of(item).ok()) {
        text.push_str(&name_of(&key));
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::args::tests::config;
    use crate::config::ConfigCommand;

    fn check(line: &str, output: Output) -> Result<(), CliError> {
        let ConfigCommand::Get(options) = config(&format!("get {line}")).unwrap() else {
            panic!("{line}");
        };
        let key = options.document.target.optional_key(options.document.name.as_deref())?;
        options.check(key.as_ref(), output)
    }

    #[test]
    fn options_that_make_no_sense_together_are_refused() {
        for good in [
            "nodes",
            "no robot-1 --revision 4",
            "inst --service slam",
            "node/a -w",
            "nodes -l a=b --layer edge -w",
        ] {
            check(good, Output::Table).unwrap_or_else(|error| panic!("{good}: {error}"));
        }
        for bad in [
            "node a -l x=y",
            "nodes --service slam",
            "nodes --revision 3",
            "nodes -w --limit 3",
            "node a -w --revision 3",
            "inst -w --node robot-1",
        ] {
            assert!(matches!(check(bad, Output::Table), Err(CliError::Usage(_))), "{bad}");
        }
        assert!(check("nodes -w", Output::Name).is_err());
        assert!(
            check("svc slam --reveal", Output::Yaml).is_ok()
                && check("services --reveal", Output::Json).is_ok()
        );
        assert!(check("svc slam --reveal", Output::Table).is_err());
        assert!(check("svc slam --reveal -w", Output::Json).is_err());
    }

    #[test]
    fn names_stand_one_a_line() {
        let items = [
            json!({"kind": "Node", "name": "robot-1"}),
            json!({"kind": "Instance", "service": "slam", "name": "0"}),
            json!({}),
        ];
        assert_eq!(names(&items), "node/robot-1\ninstance/slam/0\n");
    }
}
