//! A backup as a file of JSON lines.
//!
//! ```text
//! {"format":1,"store_id":…,"revision":412,"floor":0,"time":…}
//! {"document":{…}}   {"version":{…}}   {"audit":{…}}   {"token":{…}}   {"idempotency":{…}}
//! {"end":{"counts":{"documents":3,…},"sha256":"…"}}            over all bytes before this line
//! ```
//!
//! Secrets in it are encrypted as in the store. A restore reads the file twice: it is checked to
//! its end before the first line is stored.

use std::io::{BufRead, Seek, SeekFrom, Write};

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use tokio::sync::mpsc;

use super::StoreError;
use super::migrate::hex;
use super::upkeep::{BackupHead, BackupRow, Counts, Piece, Restored, Upkeep};

/// Pieces between the store and the file.
const QUEUE: usize = 256;
/// Longest line: an answer to repeat may be as large as what `apply` takes, and is escaped once
/// more here.
const MAX_LINE_BYTES: u64 = 64 * 1024 * 1024;

/// Why a backup was not written or restored.
#[derive(Debug, thiserror::Error)]
pub enum BackupError {
    /// The store.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The file.
    #[error("the backup file: {0}")]
    File(#[from] std::io::Error),
    /// A line that no backup has.
    #[error("line {line} of the backup: {detail}; nothing was restored")]
    Line {
        /// From 1.
        line: u64,
        /// What is wrong.
        detail: String,
    },
}

/// What was written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Summary {
    /// Of which store, at which revision.
    pub head: BackupHead,
    /// How much.
    pub counts: Counts,
}

#[derive(Serialize, Deserialize)]
struct Trailer {
    end: End,
}

#[derive(Serialize, Deserialize)]
struct End {
    counts: Counts,
    sha256: String,
}

/// Writes what a store exports. `export` is [`Upkeep::export`] or [`super::export`] with the sender
/// that it is given.
///
/// # Errors
/// [`BackupError`]; what was written until then is no backup, as it has no last line.
pub async fn write<E, F>(export: E, out: &mut (dyn Write + Send)) -> Result<Summary, BackupError>
where
    E: FnOnce(mpsc::Sender<Piece>) -> F,
    F: Future<Output = Result<(), StoreError>>,
{
    let (sender, receiver) = mpsc::channel(QUEUE);
    // A failed write drops the receiver, which ends the export; then the file's error is the one
    // that counts.
    let (exported, written) = tokio::join!(export(sender), write_pieces(receiver, out));
    let written = written?;
    exported?;
    Ok(written.ok_or_else(super::upkeep::not_whole)?)
}

async fn write_pieces(
    mut pieces: mpsc::Receiver<Piece>,
    out: &mut (dyn Write + Send),
) -> Result<Option<Summary>, BackupError> {
    let mut lines = Lines::new(out);
    let mut head = None;
    while let Some(piece) = pieces.recv().await {
        match piece {
            Piece::Head(first) => {
                lines.line(&first)?;
                head = Some(first);
            }
            Piece::Row(row) => {
                *lines.counts.entry(row.0.table().to_owned()).or_insert(0) += 1;
                lines.line(&row)?;
            }
            Piece::End => {
                let counts = lines.end()?;
                return Ok(head.map(|head| Summary { head, counts }));
            }
        }
    }
    Ok(None)
}

/// Lines on their way into the file.
struct Lines<'a> {
    out: &'a mut (dyn Write + Send),
    hash: Sha256,
    counts: Counts,
}

impl<'a> Lines<'a> {
    fn new(out: &'a mut (dyn Write + Send)) -> Self {
        Self { out, hash: Sha256::new(), counts: Counts::new() }
    }

    fn line(&mut self, value: &impl Serialize) -> Result<(), BackupError> {
        let mut line = serde_json::to_vec(value).map_err(std::io::Error::from)?;
        line.push(b'\n');
        self.hash.update(&line);
        self.out.write_all(&line)?;
        Ok(())
    }

    fn end(mut self) -> Result<Counts, BackupError> {
        let sha256 = hex(&self.hash.clone().finalize());
        let end = End { counts: self.counts.clone(), sha256 };
        self.line(&Trailer { end })?;
        self.out.flush()?;
        Ok(self.counts)
    }
}

/// Restores a backup into an empty store.
///
/// # Errors
/// [`BackupError`]; then the store is as empty as before.
pub async fn restore<R: BufRead + Seek + Send>(
    store: &dyn Upkeep,
    file: &mut R,
) -> Result<Restored, BackupError> {
    check(file)?;
    restore_checked(store, file).await
}

/// As [`restore`], for a file that [`check`] has read to its end and found good.
///
/// # Errors
/// As [`restore`].
pub async fn restore_checked<R: BufRead + Seek + Send>(
    store: &dyn Upkeep,
    file: &mut R,
) -> Result<Restored, BackupError> {
    file.seek(SeekFrom::Start(0))?;
    let (sender, receiver) = mpsc::channel(QUEUE);
    let (read, imported) = tokio::join!(read_pieces(file, sender), store.import(receiver));
    read?;
    Ok(imported?)
}

async fn read_pieces<R: BufRead + Send>(
    file: &mut R,
    pieces: mpsc::Sender<Piece>,
) -> Result<(), BackupError> {
    let mut reader = Reader::new(file);
    while let Some(line) = reader.next_line()? {
        let piece = match line {
            Line::Head(head) => Piece::Head(head),
            Line::Row(row) => Piece::Row(row),
            Line::End(_) => Piece::End,
        };
        if pieces.send(piece).await.is_err() {
            // The import has ended, and says why.
            break;
        }
    }
    Ok(())
}

/// Reads a backup to its end and checks it.
///
/// # Errors
/// [`BackupError::File`], [`BackupError::Line`].
pub fn check<R: BufRead>(file: &mut R) -> Result<Summary, BackupError> {
    let mut reader = Reader::new(file);
    let mut head = None;
    let mut counts = Counts::new();
    loop {
        let before = reader.hash.clone();
        match reader.next_line()? {
            Some(Line::Head(first)) => head = Some(first),
            Some(Line::Row(row)) => *counts.entry(row.0.table().to_owned()).or_insert(0) += 1,
            Some(Line::End(end)) => {
                let Some(head) = head else {
                    return Err(reader.fault("it is the only one"));
                };
                if end.sha256 != hex(&before.finalize()) || end.counts != counts {
                    return Err(reader.fault("the lines before are not those that were written"));
                }
                if reader.next_line()?.is_some() {
                    return Err(reader.fault("it comes after the last line"));
                }
                return Ok(Summary { head, counts });
            }
            None => {
                return Err(
                    reader.fault("the last line is missing: the backup was not written to its end")
                );
            }
        }
    }
}

enum Line {
    Head(BackupHead),
    Row(BackupRow),
    End(End),
}

/// Lines out of a file.
struct Reader<'a, R> {
    file: &'a mut R,
    hash: Sha256,
    line: u64,
    ended: bool,
}

impl<'a, R: BufRead> Reader<'a, R> {
    fn new(file: &'a mut R) -> Self {
        Self { file, hash: Sha256::new(), line: 0, ended: false }
    }

    fn next_line(&mut self) -> Result<Option<Line>, BackupError> {
        self.line += 1;
        let mut bytes = Vec::new();
        let read =
            std::io::Read::take(&mut *self.file, MAX_LINE_BYTES).read_until(b'\n', &mut bytes)?;
        if read == 0 {
            return Ok(None);
        }
        if bytes.last() != Some(&b'\n') {
            return Err(self.fault("it has no end"));
        }
        if self.ended {
            return Err(self.fault("it comes after the last line"));
        }
        self.hash.update(&bytes);
        let detail = |error: serde_json::Error| error.to_string();
        let line = if self.line == 1 {
            serde_json::from_slice(&bytes).map(Line::Head)
        } else if bytes.starts_with(b"{\"end\":") {
            self.ended = true;
            serde_json::from_slice::<Trailer>(&bytes).map(|trailer| Line::End(trailer.end))
        } else {
            serde_json::from_slice(&bytes).map(Line::Row)
        };
        let line = line.map_err(|error| self.fault(detail(error)))?;
        match &line {
            Line::Head(head) if head.format != 1 => {
                Err(self.fault(format!("form {} is unknown: take a newer program", head.format)))
            }
            Line::Head(_) | Line::Row(_) | Line::End(_) => Ok(Some(line)),
        }
    }

    fn fault(&self, detail: impl Into<String>) -> BackupError {
        BackupError::Line { line: self.line, detail: detail.into() }
    }
}

#[cfg(test)]
#[path = "backup_tests.rs"]
mod tests;
