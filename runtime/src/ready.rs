//! The one line that tells scripts that a program is ready.

use std::io::{self, Write};
use std::net::SocketAddr;

/// Prints `ready admin=127.0.0.1:9101` on stdout, with one `key=value` per address, and flushes it.
///
/// # Errors
/// If stdout is closed.
pub fn ready_line(addresses: &[(&str, SocketAddr)]) -> io::Result<()> {
    write_ready_line(&mut io::stdout().lock(), addresses)
}

fn write_ready_line(out: &mut impl Write, addresses: &[(&str, SocketAddr)]) -> io::Result<()> {
    let mut line = "ready".to_owned();
    for (name, address) in addresses {
        line.push_str(&format!(" {name}={address}"));
    }
    line.push('\n');
    // One write: a reader never sees half a line.
    out.write_all(line.as_bytes())?;
    out.flush()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_reads_as_documented() {
        let mut out = Vec::new();
        let admin = "127.0.0.1:9104".parse().unwrap();
        write_ready_line(&mut out, &[("admin", admin), ("rest", "[::1]:8080".parse().unwrap())])
            .unwrap();
        assert_eq!(out, b"ready admin=127.0.0.1:9104 rest=[::1]:8080\n");
    }
}
