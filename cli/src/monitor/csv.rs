//! Raw samples in a file: a heading, then one line a sample. Cells are names and numbers, which
//! need no quotes.

use std::fmt::Display;
use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};

use crate::exit::CliError;

/// A file that is being written.
#[derive(Debug)]
pub(crate) struct CsvFile {
    path: PathBuf,
    file: BufWriter<File>,
}

impl CsvFile {
    /// Creates or empties the file and writes its heading.
    ///
    /// # Errors
    /// [`CliError::Failed`] where it cannot be written.
    pub(crate) fn create(path: &Path, heading: &[&str]) -> Result<Self, CliError> {
        let file = File::create(path).map_err(|error| fault(path, &error))?;
        let mut csv = Self { path: path.to_owned(), file: BufWriter::new(file) };
        csv.line(&heading.join(","))?;
        Ok(csv)
    }

    /// Writes one line.
    ///
    /// # Errors
    /// As [`Self::create`].
    pub(crate) fn line(&mut self, cells: &dyn Display) -> Result<(), CliError> {
        writeln!(self.file, "{cells}").map_err(|error| fault(&self.path, &error))
    }

    /// Hands everything to the system.
    ///
    /// # Errors
    /// As [`Self::create`].
    pub(crate) fn flush(&mut self) -> Result<(), CliError> {
        self.file.flush().map_err(|error| fault(&self.path, &error))
    }
}

fn fault(path: &Path, error: &std::io::Error) -> CliError {
    CliError::Failed(format!("{}: {error}", path.display()))
}

/// A number of milliseconds with three decimals; empty where there is none.
pub(crate) fn millis(value: Option<f64>) -> String {
    value.map_or_else(String::new, |value| format!("{value:.3}"))
}
