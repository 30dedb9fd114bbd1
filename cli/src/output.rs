//! Tables for people, JSON and YAML for programs.

use std::io::{IsTerminal as _, Write};

use comfy_table::{CellAlignment, ContentArrangement, Table, presets};
use serde_json::Value;

use crate::exit::CliError;

/// What `-o` takes. Every command has the formats of [`Format`]; `get` has all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Output {
    /// For people
    Table,
    /// For people, with more columns (`get` alone)
    Wide,
    /// KIND/NAME alone, one a line (`get` alone)
    Name,
    /// As the server answers
    Json,
    /// The same as YAML
    Yaml,
}

impl Output {
    /// The format of a command that has no names and no more columns.
    ///
    /// # Errors
    /// [`CliError::Usage`] for the other two.
    pub fn format(self) -> Result<Format, CliError> {
        match self {
            Self::Table => Ok(Format::Table),
            Self::Json => Ok(Format::Json),
            Self::Yaml => Ok(Format::Yaml),
            Self::Wide | Self::Name => Err(CliError::Usage(
                "-o wide and -o name are for `blaze get`; here there are table, json and yaml"
                    .to_owned(),
            )),
        }
    }
}

/// How results are printed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// For people.
    Table,
    /// As the server answers.
    Json,
    /// The same as YAML.
    Yaml,
}

/// Where a column's content stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Align {
    /// Words.
    Left,
    /// Numbers.
    Right,
}

/// Columns of a terminal for which a table is worth wrapping. One that nobody has told its size says
/// that it has none.
const NARROWEST: u16 = 40;

/// Width of the terminal in columns; `None` when standard output is none, or it is too narrow.
#[must_use]
pub fn terminal_width() -> Option<u16> {
    Table::new().width().filter(|width| *width >= NARROWEST)
}

/// A column: its heading, where its content stands, and what it shows of an item.
pub type Column<'a, T> = (&'a str, Align, &'a dyn Fn(&T) -> String);

/// Lays out items under headings; wraps cells so that lines fit `width`, and does not wrap without
/// one.
#[must_use]
pub fn table<T>(items: &[T], width: Option<u16>, columns: &[Column<'_, T>]) -> String {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.set_header(columns.iter().map(|(name, ..)| *name));
    for item in items {
        table.add_row(columns.iter().map(|(_, _, show)| show(item)));
    }
    match width {
        Some(width) => {
            table.set_width(width);
            table.set_content_arrangement(ContentArrangement::Dynamic);
        }
        None => {
            table.set_content_arrangement(ContentArrangement::Disabled);
        }
    }
    for (index, (_, align, _)) in columns.iter().enumerate() {
        if let Some(column) = table.column_mut(index) {
            column.set_padding((0, 2));
            if *align == Align::Right {
                column.set_cell_alignment(CellAlignment::Right);
            }
        }
    }
    table.lines().map(|line| format!("{}\n", line.trim_end())).collect()
}

/// Writes a text to standard output, with a newline at its end.
///
/// # Errors
/// [`CliError::OutputClosed`] when nobody reads it any more, [`CliError::Failed`] for a full disk
/// and the like.
pub fn print(text: &str) -> Result<(), CliError> {
    let newline = if text.ends_with('\n') { "" } else { "\n" };
    write_text(&mut std::io::stdout().lock(), &format!("{text}{newline}"))
}

/// Writes a text as it is.
///
/// # Errors
/// [`CliError::OutputClosed`] when nobody reads it any more, [`CliError::Failed`] for a full disk
/// and the like.
pub(crate) fn write_text(to: &mut impl Write, text: &str) -> Result<(), CliError> {
    let written = to.write_all(text.as_bytes()).and_then(|()| to.flush());
    written.map_err(|error| match error.kind() {
        std::io::ErrorKind::BrokenPipe => CliError::OutputClosed,
        _ => CliError::Failed(format!("standard output: {error}")),
    })
}

/// An object in one of the formats for programs, or the text that `table` makes of it.
///
/// # Errors
/// [`CliError::Failed`] when YAML cannot hold it; whatever `table` says.
pub fn format_object(
    value: &Value,
    format: Format,
    table: impl FnOnce(&Value) -> Result<String, CliError>,
) -> Result<String, CliError> {
    match format {
        Format::Table => table(value),
        Format::Json => {
            serde_json::to_string_pretty(value).map_err(|error| CliError::Failed(error.to_string()))
        }
        Format::Yaml => {
            yaml_serde::to_string(value).map_err(|error| CliError::Failed(error.to_string()))
        }
    }
}

/// Prints a value that is looked at again and again: a table replaces the one before where standard
/// output is a terminal, JSON is one line, YAML a document.
///
/// # Errors
/// As [`print()`] and [`format_object`].
pub fn print_look(
    value: &Value,
    format: Format,
    table: impl FnOnce(&Value) -> Result<String, CliError>,
) -> Result<(), CliError> {
    let text = match format {
        Format::Json => value.to_string(),
        Format::Table | Format::Yaml => format_object(value, format, table)?,
    };
    let begin = match format {
        // Home, and clear what is below.
        Format::Table if std::io::stdout().is_terminal() => "\x1b[H\x1b[J",
        Format::Yaml => "---\n",
        Format::Table | Format::Json => "",
    };
    print(&format!("{begin}{text}"))
}

/// Bytes with a binary unit: `921.6 KB` would be wrong here, `900.0 KiB` is meant.
#[must_use]
pub fn bytes(count: f64) -> String {
    const UNITS: [&str; 5] = ["B", "KiB", "MiB", "GiB", "TiB"];
    let mut value = count;
    let mut unit = 0;
    while value >= 1024.0 && unit + 1 < UNITS.len() {
        value /= 1024.0;
        unit += 1;
    }
    if unit == 0 {
        format!("{value:.0} {}", UNITS[unit])
    } else {
        format!("{value:.1} {}", UNITS[unit])
    }
}

/// A number with a fixed count of decimals, or a dash where there is none.
#[must_use]
pub fn number(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.decimals$}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_get_has_all_formats() {
        assert_eq!(Output::Yaml.format().unwrap(), Format::Yaml);
        for output in [Output::Wide, Output::Name] {
            assert!(matches!(output.format(), Err(CliError::Usage(_))));
        }
    }

    const COLUMNS: [Column<'_, (&str, &str)>; 2] = [
        ("TOPIC", Align::Left, &|row| row.0.to_owned()),
        ("HZ", Align::Right, &|row| row.1.to_owned()),
    ];

    #[test]
    fn tables_are_plain_aligned_and_fit_the_terminal() {
        assert_eq!(
            table(&[("imu/data", "50.0"), ("x", "1.0")], None, &COLUMNS),
            "TOPIC       HZ\nimu/data  50.0\nx          1.0\n"
        );
        let text =
            table(&[("a/rather/long/topic name/with many/parts", "50.0")], Some(24), &COLUMNS);
        assert!(text.lines().count() > 2, "{text}");
        assert!(text.lines().all(|line| line.chars().count() <= 24), "{text}");
    }

    #[test]
    fn bytes_have_units() {
        assert_eq!(bytes(0.0), "0 B");
        assert_eq!(bytes(921_600.0), "900.0 KiB");
        assert_eq!(bytes(5e15), "4547.5 TiB");
    }
}
