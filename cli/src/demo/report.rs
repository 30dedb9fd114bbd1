//! What the demo prints: a live table on a terminal, plain lines elsewhere, JSON lines for programs.

use std::collections::BTreeMap;
use std::io::Write;
use std::time::Duration;

use serde::Serialize;

use super::board::TopicRow;
use super::verdict::Summary;
use crate::exit::CliError;
use crate::output::{Align, Format, bytes, number, render_table, terminal_width};

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
                "the demo prints a table or, with -o json, one JSON object a line; not YAML.".to_owned(),
            )),
        }
    }
}

/// Prints the demo's progress and end. Events go to the second writer where the first is for programs.
pub struct Report<Out, Err> {
    style: Style,
    out: Out,
    err: Err,
    /// Lines of the live table that stand on the screen.
    drawn: usize,
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
        Self {
            style,
            out,
            err,
            drawn: 0,
        }
    }

    /// Something happened, in a sentence.
    ///
    /// # Errors
    /// [`CliError::OutputClosed`] when nobody reads it any more.
    pub fn event(&mut self, at: Duration, text: &str) -> Result<(), CliError> {
        let line = format!("{:5.1} s  {text}\n", at.as_secs_f64());
        match self.style {
            Style::Live { .. } => {
                let clear = self.clear();
                write(&mut self.out, &format!("{clear}{line}"))
            }
            Style::Lines => write(&mut self.out, &line),
            Style::Json => write(&mut self.err, &line),
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
                self.drawn = text.lines().count();
                write(&mut self.out, &format!("{clear}{text}"))
            }
            Style::Lines if at.as_secs().is_multiple_of(LINES_PERIOD_S) => {
                let text: String = rows.iter().map(|row| plain_line(at, row)).collect();
                write(&mut self.out, &text)
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
        write(&mut self.out, &format!("{clear}{}", summary_text(summary, width)))
    }

    fn json(&mut self, line: &Line<'_>) -> Result<(), CliError> {
        let text = serde_json::to_string(line).map_err(|error| CliError::Failed(error.to_string()))?;
        write(&mut self.out, &format!("{text}\n"))
    }

    /// Moves to the first line of the table that stands there and clears to the end of the screen.
    fn clear(&mut self) -> String {
        match std::mem::take(&mut self.drawn) {
            0 => String::new(),
            lines => format!("\x1b[{lines}A\r\x1b[0J"),
        }
    }
}

fn write(to: &mut impl Write, text: &str) -> Result<(), CliError> {
    to.write_all(text.as_bytes())
        .and_then(|()| to.flush())
        .map_err(|error| match error.kind() {
            std::io::ErrorKind::BrokenPipe => CliError::OutputClosed,
            _ => CliError::Failed(format!("standard output: {error}")),
        })
}

const LIVE_COLUMNS: [(&str, Align); 10] = [
    ("TOPIC", Align::Left),
    ("FROM", Align::Left),
    ("TO", Align::Left),
    ("ROUTE", Align::Left),
    ("IN/Hz", Align::Right),
    ("OUT/Hz", Align::Right),
    ("BYTES/s", Align::Right),
    ("p50/ms", Align::Right),
    ("p99/ms", Align::Right),
    ("DROPPED", Align::Left),
];

fn live_table(at: Duration, rows: &[TopicRow], width: u16) -> String {
    let cells = rows
        .iter()
        .take(MAX_LIVE_ROWS)
        .map(|row| {
            vec![
                row.topic.clone(),
                row.from.clone(),
                to_text(row),
                row.route.join(" "),
                number(row.rate_in_hz, 1),
                number(Some(row.rate_out_hz), 1),
                bytes(row.bytes_per_s),
                number(row.latency_ms.p50, 1),
                number(row.latency_ms.p99, 1),
                dropped_text(&row.dropped),
            ]
        })
        .collect();
    let mut text = format!("{} s, the last second:\n", at.as_secs());
    text.push_str(&render_table(&LIVE_COLUMNS, cells, Some(width)));
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

fn dropped_text(dropped: &BTreeMap<String, u64>) -> String {
    crate::admin::dropped_text(dropped)
}

const SUMMARY_COLUMNS: [(&str, Align); 10] = [
    ("TOPIC", Align::Left),
    ("TO", Align::Left),
    ("SENT", Align::Right),
    ("RECEIVED", Align::Right),
    ("LOST", Align::Right),
    ("TWICE", Align::Right),
    ("REORDERED", Align::Right),
    ("p50/ms", Align::Right),
    ("p99/ms", Align::Right),
    ("DROPPED", Align::Left),
];

fn summary_text(summary: &Summary, width: Option<u16>) -> String {
    let cells = summary
        .topics
        .iter()
        .map(|row| {
            vec![
                row.topic.clone(),
                to_text(row),
                row.sent.map_or_else(|| "-".to_owned(), |sent| sent.to_string()),
                row.received.to_string(),
                row.lost.to_string(),
                row.duplicated.to_string(),
                row.reordered.to_string(),
                number(row.latency_ms.p50, 2),
                number(row.latency_ms.p99, 2),
                dropped_text(&row.dropped),
            ]
        })
        .collect();
    let mut text = format!("\nAfter {:.1} s:\n", summary.duration_s);
    text.push_str(&render_table(&SUMMARY_COLUMNS, cells, width));
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
        return "OK: every topic arrived at every consumer here, nothing that must arrive was lost, doubled or out of \
                order, and what was left out has its reason above.\n"
            .to_owned();
    }
    let mut text = "NOT OK:\n".to_owned();
    for problem in &summary.problems {
        text.push_str(&format!("  - {problem}\n"));
    }
    text.push_str(
        "`blaze why TOPIC --flow HOST:PORT` tells while the demo runs; its nodes name their ports at the start.\n",
    );
    text
}

#[cfg(test)]
#[path = "report_tests.rs"]
mod tests;
