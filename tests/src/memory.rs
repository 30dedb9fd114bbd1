//! What stands in the memory of a process, as whoever has a core dump of it would see it.

use std::fs::File;
use std::os::unix::fs::FileExt as _;

use anyhow::Context as _;

/// Read at a time.
const CHUNK: usize = 4 << 20;

/// How often a text stands in all that a process has mapped and may read.
///
/// # Errors
/// When the system does not let anybody look.
pub(crate) fn count(id: u32, needle: &[u8]) -> anyhow::Result<usize> {
    let maps = std::fs::read_to_string(format!("/proc/{id}/maps"))?;
    let memory = File::open(format!("/proc/{id}/mem"))
        .with_context(|| format!("the memory of process {id}"))?;
    let (mut count, mut read) = (0, 0);
    for line in maps.lines() {
        let mut words = line.split_whitespace();
        let (range, rights) = (words.next().unwrap_or_default(), words.next().unwrap_or_default());
        // The kernel's own pages cannot be read from outside.
        if !rights.starts_with('r') || line.contains("[v") {
            continue;
        }
        let (from, to) = range.split_once('-').with_context(|| line.to_owned())?;
        let (from, to) = (u64::from_str_radix(from, 16)?, u64::from_str_radix(to, 16)?);
        let bytes = range_of(&memory, from, to);
        read += bytes.len();
        count += occurrences(&bytes, needle);
    }
    anyhow::ensure!(read > CHUNK, "only {read} bytes of process {id} could be read");
    Ok(count)
}

/// A range of memory; what has gone meanwhile is left out.
fn range_of(memory: &File, from: u64, to: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut at = from;
    while at < to {
        let length = CHUNK.min(usize::try_from(to - at).unwrap_or(CHUNK));
        let begin = bytes.len();
        bytes.resize(begin + length, 0);
        match memory.read_at(&mut bytes[begin..], at) {
            Ok(read @ 1..) => {
                bytes.truncate(begin + read);
                at += read as u64;
            }
            Ok(0) | Err(_) => {
                bytes.truncate(begin);
                break;
            }
        }
    }
    bytes
}

fn occurrences(bytes: &[u8], needle: &[u8]) -> usize {
    let Some(first) = needle.first() else { return 0 };
    let begins = bytes.iter().enumerate().filter(|(_, byte)| *byte == first);
    begins.filter(|(at, _)| bytes[*at..].starts_with(needle)).count()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_this_process_holds_is_found() {
        // Made at run time, so that it stands nowhere in the program.
        let held: String = "lamrof".chars().rev().chain("-7c1e-held".chars()).collect();
        let count = count(std::process::id(), held.as_bytes()).unwrap();
        assert!(count >= 1, "{held}");
        assert_eq!(occurrences(b"aXbXXbX", b"Xb"), 2);
    }
}
