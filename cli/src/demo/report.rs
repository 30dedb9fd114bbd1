//! What the demo prints: a live table on a terminal, plain lines elsewhere, JSON lines for
//! programs.

use std::io::Write;
use std::time::Duration;

use serde::Serialize;

use super::board::TopicRow;
use super::verdict::Summary;
use crate::admin::dropped_text;
use crate::exit::CliError;
use crate::output::{self, Align, Format, bytes, number, terminal_width, write_text};

/// Plain lines come every so many seconds.
const LINES_PERIOD_S: u64 = 5;
/// Most rows of the live table; a recording may have more topics than a screen has lines.
const MAX_LIVE_ROWS: usize = 40;

/// How to print.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Style {
    /// A table that is drawn anew in place.
    Live {
        /// Columns of the terminal.
        width: u16,
    },
    /// One line per topic and consumer every few seconds.
    Lines,
    /// One JSON object a line.
    Json,
}

impl Style {
    /// The style for a format and this process's standard output.
    ///
    /// # Errors
    /// [`CliError::Usage`] for YAML.
    pub fn choose(format: Format) -> Result<Self, CliError> {
        match (format, terminal_width()) {
            (Format::Table, Some(width)) => Ok(Self::Live { width }),
            (Format::Table, None) => Ok(Self::Lines),
            (Format::Json, _) => Ok(Self::Json),
            (Format::Yaml, _) => Err(CliError::Usage(
                "the demo prints a table or, with -o json, one JSON object a line; not YAML."
                    .to_owned(),
            )),
        }
    }
}

/// Prints the demo's progress and end. Events go to the second writer where the first is for
/// programs.
pub struct Report<Out, Err> {
    style: Style,
    out: Out,
    err: Err,
    /// The live table that stands on the screen.
    drawn: String,
}

#[derive(Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
enum Line<'a> {
    Row(&'a TopicRow),
    Summary(&'a Summary),
}

impl<Out: Write, Err: Write> Report<Out, Err> {
    /// A report that has printed nothing yet.
    pub fn new(style: Style, out: Out, err: Err) -> Self {
        Self { style, out, err, drawn: String::new() }
    }

    /// Something happened, in a sentence.
    ///
    /// # Errors
    /// [`CliError::OutputClosed`] when nobody reads it any more.
    pub fn event(&mut self, at: Duration, text: &str) -> Result<(), CliError> {
        let line = format!("{:5.1} s  {text}\n", at.as_secs_f64());
        match self.style {
            Style::Live { .. } => {
                // The table stays below what is told.
                let clear = self.clear();
                write_text(&mut self.out, &format!("{clear}{line}{}", self.drawn))
            }
            Style::Lines => write_text(&mut self.out, &line),
            Style::Json => write_text(&mut self.err, &line),
        }
    }

    /// The last second.
    ///
    /// # Errors
    /// As [`Report::event`].
    pub fn rows(&mut self, at: Duration, rows: &[TopicRow]) -> Result<(), CliError> {
        match self.style {
            Style::Live { width } => {
                let text = live_table(at, rows, width);
                let clear = self.clear();
                self.drawn = text;
                write_text(&mut self.out, &format!("{clear}{}", self.drawn))
            }
            Style::Lines if at.as_secs().is_multiple_of(LINES_PERIOD_S) => {
                let text: String = rows.iter().map(|row| plain_line(at, row)).collect();
                write_text(&mut self.out, &text)
            }
            Style::Lines => Ok(()),
            Style::Json => rows.iter().try_for_each(|row| self.json(&Line::Row(row))),
        }
    }

    /// The end.
    ///
    /// # Errors
    /// As [`Report::event`].
    pub fn summary(&mut self, summary: &Summary) -> Result<(), CliError> {
        let width = match self.style {
            Style::Json => return self.json(&Line::Summary(summary)),
            Style::Live { width } => Some(width),
            Style::Lines => None,
        };
        let clear = self.clear();
        self.drawn.clear();
        write_text(&mut self.out, &format!("{clear}{}", summary_text(summary, width)))
    }

    fn json(&mut self, line: &Line<'_>) -> Result<(), CliError> {
        let text =
            serde_json::to_string(line).map_err(|error| CliError::Failed(error.to_string()))?;
        write_text(&mut self.out, &format!("{text}\n"))
    }

    /// Moves to the first line of the table that stands there and clears to the end of the screen.
    fn clear(&self) -> String {
        match self.drawn.lines().count() {
            0 => String::new(),
            lines => format!("\x1b[{lines}A\r\x1b[0J"),
        }
    }
}

fn live_table(at: Duration, rows: &[TopicRow], width: u16) -> String {
    let mut text = format!("{} s, the last second:\n", at.as_secs());
    let shown = rows.get(..MAX_LIVE_ROWS).unwrap_or(rows);
    text.push_str(&output::table(
        shown,
        Some(width),
        &[
            ("TOPIC", Align::Left, &|row| row.topic.clone()),
            ("FROM", Align::Left, &|row| row.from.clone()),
            ("TO", Align::Left, &to_text),
            ("ROUTE", Align::Left, &|row| row.route.join(" ")),
            ("IN/Hz", Align::Right, &|row| number(row.rate_in_hz, 1)),
            ("OUT/Hz", Align::Right, &|row| number(Some(row.rate_out_hz), 1)),
            ("BYTES/s", Align::Right, &|row| bytes(row.bytes_per_s)),
            ("p50/ms", Align::Right, &|row| number(row.latency_ms.p50, 1)),
            ("p99/ms", Align::Right, &|row| number(row.latency_ms.p99, 1)),
            ("DROPPED", Align::Left, &|row| dropped_text(&row.dropped)),
        ],
    ));
    if let Some(more) = rows.len().checked_sub(MAX_LIVE_ROWS).filter(|more| *more > 0) {
        text.push_str(&format!("… and {more} more\n"));
    }
    text
}

fn plain_line(at: Duration, row: &TopicRow) -> String {
    format!(
        "{:5.1} s  {} {} → {}: {} Hz in, {:.1} Hz out, {}/s, p50 {} ms, p99 {} ms, dropped {}\n",
        at.as_secs_f64(),
        row.topic,
        row.from,
        to_text(row),
        number(row.rate_in_hz, 1),
        row.rate_out_hz,
        bytes(row.bytes_per_s),
        number(row.latency_ms.p50, 1),
        number(row.latency_ms.p99, 1),
        dropped_text(&row.dropped),
    )
}

/// Node and service of a consumer: `cloud/cloud-1 recorder`.
fn to_text(row: &TopicRow) -> String {
    match (&row.to, row.service) {
        (Some(to), Some(service)) => format!("{to} {service}"),
        (Some(to), None) => to.clone(),
        (None, _) => "-".to_owned(),
    }
}

fn summary_text(summary: &Summary, width: Option<u16>) -> String {
    let mut text = format!("\nAfter {:.1} s:\n", summary.duration_s);
    text.push_str(&output::table(
        &summary.topics,
        width,
        &[
            ("TOPIC", Align::Left, &|row| row.topic.clone()),
            ("TO", Align::Left, &to_text),
            ("SENT", Align::Right, &|row| {
                row.sent.map_or_else(|| "-".to_owned(), |sent| sent.to_string())
            }),
            ("RECEIVED", Align::Right, &|row| row.received.to_string()),
            ("LOST", Align::Right, &|row| row.lost.to_string()),
            ("TWICE", Align::Right, &|row| row.duplicated.to_string()),
            ("REORDERED", Align::Right, &|row| row.reordered.to_string()),
            ("p50/ms", Align::Right, &|row| number(row.latency_ms.p50, 2)),
            ("p99/ms", Align::Right, &|row| number(row.latency_ms.p99, 2)),
            ("DROPPED", Align::Left, &|row| dropped_text(&row.dropped)),
        ],
    ));
    text.push('\n');
    let first: Vec<String> = summary
        .first_message_s
        .iter()
        .map(|(layer, seconds)| format!("{layer} {seconds:.1} s"))
        .collect();
    if !first.is_empty() {
        text.push_str(&format!("First message after the start: {}.\n", first.join(", ")));
    }
    for moved in &summary.moves {
        text.push_str(&format!(
            "{} moved from {} to {}: {:.0} ms without a message.\n",
            moved.service, moved.from, moved.to, moved.gap_ms
        ));
    }
    for change in &summary.changes {
        text.push_str(&format!("{}.\n  {}.\n", change.asked(), change.effect_text()));
    }
    text.push_str(&verdict_text(summary));
    text
}

fn verdict_text(summary: &Summary) -> String {
    if summary.ok && summary.topics.iter().all(|row| row.to.is_none()) {
        return "OK: everything was published; nobody listens in this process.\n".to_owned();
    }
    if summary.ok {
        return "OK: every topic arrived at every consumer here, nothing that must arrive was lost, \
                doubled or out of \
                order, and what was left out has its reason above.\n"
            .to_owned();
    }
    let mut text = "NOT OK:\n".to_owned();
    for problem in &summary.problems {
        text.push_str(&format!("  - {problem}\n"));
    }
    text.push_str(
        "`blaze why TOPIC --flow HOST:PORT` tells while the demo runs; its nodes name their ports \
         at the start.\n",
    );
    text
}

#[cfg(test)]
#[path = "report_tests.rs"]
mod tests;
