//! Query parameters: each route has a closed set, each comes once.

use std::fmt::Display;
use std::str::FromStr;

use blaze_domain::config::{Code, MAX_INTEGER, Problem, Timestamp};
use blaze_domain::{NameError, TopicName};

use crate::core::ReadOptions;

macro_rules! params {
    ($($variant:ident = $name:literal, $doc:literal;)+) => {
        /// Every query parameter of every route.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub(super) enum Param {
            $(#[doc = $doc] $variant),+
        }

        impl Param {
            /// All of them.
            #[cfg(test)]
            pub(super) const ALL: &'static [Self] = &[$(Self::$variant),+];

            /// As it is written.
            pub(super) fn name(self) -> &'static str {
                match self { $(Self::$variant => $name),+ }
            }

            /// What it is for.
            pub(super) fn description(self) -> &'static str {
                match self { $(Self::$variant => $doc),+ }
            }
        }
    };
}

params! {
    Limit = "limit", "Entries of one page, at most.";
    PageToken = "page_token", "`next_page_token` of the page before; empty: the first page.";
    LabelSelector = "label_selector", "Kubernetes label selector: requirements joined by commas, \
        all must hold.";
    Layer = "layer", "Only what is in this layer.";
    Node = "node", "Only what is on this node.";
    Revision = "revision", "As it was at this revision.";
    MinRevision = "min_revision", "Waits up to 5 s until the answer reflects this revision, then \
        410 `revision_unknown`.";
    Consistency = "consistency", "`cached` allows older data and works without the database.";
    Reveal = "reveal", "Secrets as text; needs the role admin, and is audited.";
    View = "view", "`full`: with the whole document in every entry.";
    From = "from", "The revision to compare from.";
    To = "to", "The revision to compare to; default: now.";
    Cascade = "cascade", "Deletes also the documents that refer to it, in the same commit.";
    DryRun = "dry_run", "Checks the same, writes nothing.";
    Prune = "prune", "Label selector: deletes what matches and is not in the request.";
    PruneConfirm = "prune_confirm", "How many documents `prune` deletes; needed for more than 20.";
    Service = "service", "Name of a service.";
    Instance = "instance", "Name of an instance of the service.";
    AtLayer = "layer", "Layer that the configuration is for.";
    AtNode = "node", "Node that the configuration is for.";
    Explain = "explain", "Adds where every value comes from.";
    Since = "since", "Starts after this revision; default: now. `Last-Event-ID` goes before it.";
    Kind = "kind", "Only documents of this kind.";
    Name = "name", "Only documents of this name.";
    TimeoutS = "timeout_s", "Ends the stream cleanly after so many seconds.";
    DigestLayer = "layer", "Layer whose view is digested.";
    LiveView = "view", "What is looked at; default: fleet. `node` needs `node`, `topic` \
        needs `topic`.";
    LiveNode = "node", "Only this node.";
    LiveTopic = "topic", "Name of a topic.";
    PeriodMs = "period_ms", "Milliseconds between two deltas, at least.";
    WhyTopic = "topic", "Name of a topic.";
    WhyTo = "to", "Whom it should reach: layer, layer/node or layer/node/service.";
    WhyFrom = "from", "Whose publisher: layer, layer/node or layer/node/service.";
    HealthState = "state", "Only problems of this state.";
    Prefix = "prefix", "Only topics whose name begins so.";
    SeriesNode = "node", "The node whose monitor is asked.";
    Names = "names", "Names of metrics, joined by commas; default: all.";
    Subject = "subject", "Only entries of this subject.";
    AuditName = "name", "Only entries of documents of this name.";
    Action = "action", "Only entries of this action.";
    Outcome = "outcome", "Only what was allowed, or only what was denied.";
    SinceTime = "since_time", "Not before this time.";
    UntilTime = "until_time", "Before this time.";
}

/// The query of one request.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Query(Vec<(Param, String)>);

impl Query {
    /// Reads a query against what the route knows.
    ///
    /// # Errors
    /// `unknown_parameter` for what is unknown or repeated, `invalid_request` for bad
    /// percent-encoding.
    pub(super) fn parse(known: &[Param], text: Option<&str>) -> Result<Self, Problem> {
        let mut found: Vec<(Param, String)> = Vec::new();
        for pair in text.unwrap_or_default().split('&').filter(|pair| !pair.is_empty()) {
            let (name, value) = pair.split_once('=').unwrap_or((pair, ""));
            let name = decode(name)?;
            let Some(param) = known.iter().copied().find(|param| param.name() == name) else {
                return Err(Problem::new(Code::UnknownParameter, unknown(known, &name)));
            };
            if found.iter().any(|(other, _)| *other == param) {
                return Err(Problem::new(
                    Code::UnknownParameter,
                    format!("query parameter {name} comes twice"),
                ));
            }
            found.push((param, decode(value)?));
        }
        Ok(Self(found))
    }

    /// The text of a parameter.
    pub(super) fn text(&self, param: Param) -> Option<&str> {
        self.0.iter().find(|(found, _)| *found == param).map(|(_, value)| value.as_str())
    }

    /// A name.
    ///
    /// # Errors
    /// `invalid_request`.
    pub(super) fn name<T: FromStr<Err = NameError>>(
        &self,
        param: Param,
    ) -> Result<Option<T>, Problem> {
        let read = |text: &str| text.parse().map_err(|error: NameError| invalid(param, &error));
        self.text(param).map(read).transpose()
    }

    /// The name of a topic.
    ///
    /// # Errors
    /// `invalid_request`.
    pub(super) fn topic(&self, param: Param) -> Result<Option<TopicName>, Problem> {
        self.parsed(param)
    }

    /// Anything that is read from a text.
    ///
    /// # Errors
    /// `invalid_request`.
    pub(super) fn parsed<T: FromStr<Err: Display>>(
        &self,
        param: Param,
    ) -> Result<Option<T>, Problem> {
        let read = |text: &str| text.parse().map_err(|error| invalid(param, &error));
        self.text(param).map(read).transpose()
    }

    /// A time.
    ///
    /// # Errors
    /// `invalid_request`.
    pub(super) fn time(&self, param: Param) -> Result<Option<Timestamp>, Problem> {
        let read = |text: &str| {
            text.parse::<Timestamp>()
                .map_err(|_| invalid(param, &"is no RFC 3339 time, as 2026-11-21T07:01:12.345Z"))
        };
        self.text(param).map(read).transpose()
    }

    /// A whole number within bounds.
    ///
    /// # Errors
    /// `invalid_request`.
    pub(super) fn number(
        &self,
        param: Param,
        least: u64,
        most: u64,
    ) -> Result<Option<u64>, Problem> {
        let Some(text) = self.text(param) else { return Ok(None) };
        let digits = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
        match text.parse() {
            Ok(number) if digits && (least..=most).contains(&number) => Ok(Some(number)),
            _ => Err(invalid(param, &format!("is no whole number from {least} to {most}"))),
        }
    }

    /// A revision that has been, or will be.
    ///
    /// # Errors
    /// `invalid_request`.
    pub(super) fn revision(&self, param: Param) -> Result<Option<u64>, Problem> {
        self.number(param, 0, MAX_INTEGER.unsigned_abs())
    }

    /// `true` or `false`; absent is `false`.
    ///
    /// # Errors
    /// `invalid_request`.
    pub(super) fn flag(&self, param: Param) -> Result<bool, Problem> {
        Ok(self.word(param, &["false", "true"])? == Some("true"))
    }

    /// One of some words.
    ///
    /// # Errors
    /// `invalid_request`.
    pub(super) fn word(
        &self,
        param: Param,
        words: &[&'static str],
    ) -> Result<Option<&'static str>, Problem> {
        let Some(text) = self.text(param) else { return Ok(None) };
        match words.iter().find(|word| **word == text) {
            Some(word) => Ok(Some(word)),
            None => Err(invalid(param, &format!("is not one of {}", words.join(", ")))),
        }
    }

    /// `limit`.
    ///
    /// # Errors
    /// `invalid_request`.
    pub(super) fn limit(&self) -> Result<Option<u32>, Problem> {
        Ok(self.number(Param::Limit, 1, 1000)?.and_then(|limit| u32::try_from(limit).ok()))
    }

    /// `page_token`.
    pub(super) fn page_token(&self) -> &str {
        self.text(Param::PageToken).unwrap_or_default()
    }

    /// How a read is to be answered.
    ///
    /// # Errors
    /// `invalid_request`.
    pub(super) fn read_options(&self) -> Result<ReadOptions, Problem> {
        Ok(ReadOptions {
            cached: self.word(Param::Consistency, CONSISTENCY)? == Some("cached"),
            min_revision: self.revision(Param::MinRevision)?,
            at_revision: self.number(Param::Revision, 1, MAX_INTEGER.unsigned_abs())?,
            reveal: self.flag(Param::Reveal)?,
        })
    }
}

/// What `consistency` may be.
pub(super) const CONSISTENCY: &[&str] = &["strong", "cached"];

fn unknown(known: &[Param], name: &str) -> String {
    let mut names: Vec<&str> = known.iter().map(|param| param.name()).collect();
    names.sort_unstable();
    let list = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
    format!("there is no query parameter {} here; known are: {list}", quoted(name))
}

/// The value is not repeated: a problem holds nothing of the query but names.
fn invalid(param: Param, reason: &dyn Display) -> Problem {
    Problem::new(Code::InvalidRequest, format!("query parameter {} {reason}", param.name()))
}

/// A name of the request in an answer: short, and without control characters.
fn quoted(text: &str) -> String {
    let short: String = text.chars().take(64).collect();
    format!("{short:?}")
}

/// Decodes `application/x-www-form-urlencoded`.
fn decode(text: &str) -> Result<String, Problem> {
    let refuse = || Problem::new(Code::InvalidRequest, "the query is no percent-encoded UTF-8");
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.bytes();
    while let Some(byte) = rest.next() {
        match byte {
            b'+' => bytes.push(b' '),
            b'%' => {
                let mut digit = || rest.next().and_then(|digit| char::from(digit).to_digit(16));
                let (high, low) = (digit().ok_or_else(refuse)?, digit().ok_or_else(refuse)?);
                bytes.push(u8::try_from(high * 16 + low).map_err(|_| refuse())?);
            }
            other => bytes.push(other),
        }
    }
    String::from_utf8(bytes).map_err(|_| refuse())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const LIST: &[Param] =
        &[Param::Limit, Param::PageToken, Param::LabelSelector, Param::Reveal, Param::Consistency];

    fn parse(text: &str) -> Result<Query, Code> {
        Query::parse(LIST, Some(text)).map_err(|problem| problem.code)
    }

    #[test]
    fn unknown_and_repeated_parameters_are_refused() {
        assert_eq!(Query::parse(LIST, None), Ok(Query::default()));
        assert_eq!(parse(""), Ok(Query::default()));
        for bad in ["x=1", "limit=1&limit=1", "limit=1&lim%69t=1", "Limit=1", "=1", "limit=1&%20"] {
            assert_eq!(parse(bad), Err(Code::UnknownParameter), "{bad}");
        }
        for bad in ["label_selector=%", "label_selector=%f", "label_selector=%ff", "%zz=1"] {
            assert_eq!(parse(bad), Err(Code::InvalidRequest), "{bad}");
        }
        let query = parse("label_selector=site+in%20(a%2Cb)&page_token=").unwrap();
        assert_eq!(query.text(Param::LabelSelector), Some("site in (a,b)"));
        assert_eq!(query.page_token(), "");
    }

    #[test]
    fn values_have_one_spelling() {
        let limit = |text: &str| {
            parse(&format!("limit={text}")).unwrap().limit().map_err(|problem| problem.code)
        };
        assert_eq!(limit("1000"), Ok(Some(1000)));
        for bad in ["0", "1001", "-1", "+1", "1.0", "", "x", "99999999999999999999999"] {
            assert_eq!(limit(bad), Err(Code::InvalidRequest), "{bad}");
        }
        let flag = |text: &str| {
            parse(&format!("reveal={text}"))
                .unwrap()
                .flag(Param::Reveal)
                .map_err(|problem| problem.code)
        };
        assert_eq!(flag("true"), Ok(true));
        assert_eq!(flag("false"), Ok(false));
        for bad in ["", "1", "True", "yes"] {
            assert_eq!(flag(bad), Err(Code::InvalidRequest), "{bad}");
        }
        assert!(parse("consistency=cached").unwrap().read_options().unwrap().cached);
        assert!(parse("consistency=eventual").unwrap().read_options().is_err());
    }

    #[test]
    fn no_two_parameters_of_a_route_share_a_name() {
        for route in crate::api::rest::routes::all() {
            let mut names: Vec<&str> = route.query.iter().map(|param| param.name()).collect();
            names.sort_unstable();
            let count = names.len();
            names.dedup();
            assert_eq!(names.len(), count, "{}", route.operation);
        }
        assert!(Param::ALL.iter().all(|param| !param.description().is_empty()));
    }

    proptest! {
        #[test]
        fn no_query_is_too_odd(text in ".*") {
            let _ = Query::parse(LIST, Some(&text));
        }

        #[test]
        fn what_is_encoded_is_decoded(bytes in ".*") {
            let text: String = bytes.bytes().map(|byte| format!("%{byte:02x}")).collect();
            prop_assert_eq!(decode(&text), Ok(bytes));
        }
    }
}
