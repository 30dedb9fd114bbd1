//! Server-sent events (WHATWG), from bytes as they come.
//!
//! ```text
//! chunks ──► lines (LF, CR LF, CR; bounded) ──► fields: data, id, event, retry ──► empty line: one event
//! ```

use std::collections::VecDeque;
use std::time::Duration;

/// Longest line, and largest data of one event, in bytes (16 MiB).
pub(crate) const MAX_BYTES: usize = 16 * 1024 * 1024;

/// One event.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(crate) struct Event {
    /// Its name; `message` where the server gave none.
    pub(crate) name: String,
    /// The last id that the stream gave, with this event or before it.
    pub(crate) id: String,
    /// Its data, lines joined by LF.
    pub(crate) data: String,
}

/// A line or event is larger than is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("an event is larger than {} MiB", MAX_BYTES / 1024 / 1024)]
pub(crate) struct TooLarge;

/// What was read so far.
#[derive(Debug, Default)]
pub(crate) struct Parser {
    line: Vec<u8>,
    /// The last line ended with CR: a LF that follows belongs to that end.
    after_return: bool,
    began: bool,
    name: String,
    data: String,
    id: String,
    retry: Option<Duration>,
}

impl Parser {
    /// Takes the next bytes; complete events go to `out`.
    ///
    /// # Errors
    /// [`TooLarge`]; nothing more can be read then.
    pub(crate) fn push(&mut self, bytes: &[u8], out: &mut VecDeque<Event>) -> Result<(), TooLarge> {
        let mut rest = bytes;
        while let Some(first) = rest.first() {
            if std::mem::take(&mut self.after_return) && *first == b'\n' {
                rest = &rest[1..];
                continue;
            }
            let Some(end) = rest.iter().position(|byte| matches!(byte, b'\n' | b'\r')) else {
                return self.extend(rest);
            };
            self.extend(&rest[..end])?;
            self.after_return = rest[end] == b'\r';
            rest = &rest[end + 1..];
            self.end_of_line(out)?;
        }
        Ok(())
    }

    /// How long to wait before connecting again, if the server said so.
    pub(crate) fn retry(&self) -> Option<Duration> {
        self.retry
    }

    fn extend(&mut self, bytes: &[u8]) -> Result<(), TooLarge> {
        if self.line.len() + bytes.len() > MAX_BYTES {
            return Err(TooLarge);
        }
        self.line.extend_from_slice(bytes);
        Ok(())
    }

    fn end_of_line(&mut self, out: &mut VecDeque<Event>) -> Result<(), TooLarge> {
        let line = std::mem::take(&mut self.line);
        let text = String::from_utf8_lossy(&line);
        let mut text: &str = &text;
        if !std::mem::replace(&mut self.began, true) {
            text = text.strip_prefix('\u{feff}').unwrap_or(text);
        }
        if text.is_empty() {
            self.dispatch(out);
            return Ok(());
        }
        let (field, value) = text.split_once(':').unwrap_or((text, ""));
        let value = value.strip_prefix(' ').unwrap_or(value);
        match field {
            "data" => {
                if self.data.len() + value.len() > MAX_BYTES {
                    return Err(TooLarge);
                }
                self.data.push_str(value);
                self.data.push('\n');
            }
            "event" => value.clone_into(&mut self.name),
            "id" if !value.contains('\0') => value.clone_into(&mut self.id),
            "retry" if !value.is_empty() && value.bytes().all(|byte| byte.is_ascii_digit()) => {
                self.retry = value.parse().ok().map(Duration::from_millis);
            }
            // Comments (an empty field) and fields of later versions.
            _ => {}
        }
        Ok(())
    }

    fn dispatch(&mut self, out: &mut VecDeque<Event>) {
        let name = std::mem::take(&mut self.name);
        let mut data = std::mem::take(&mut self.data);
        if data.is_empty() {
            return;
        }
        data.pop();
        out.push_back(Event {
            name: if name.is_empty() { "message".to_owned() } else { name },
            id: self.id.clone(),
            data,
        });
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn read(chunks: &[&[u8]]) -> (Vec<Event>, Parser) {
        let mut parser = Parser::default();
        let mut out = VecDeque::new();
        for chunk in chunks {
            parser.push(chunk, &mut out).unwrap();
        }
        (out.into(), parser)
    }

    fn event(name: &str, id: &str, data: &str) -> Event {
        Event { name: name.to_owned(), id: id.to_owned(), data: data.to_owned() }
    }

    #[test]
    fn the_stream_of_the_contract_is_read() {
        let text =
            b"retry: 2731\nid: 413\nevent: change\ndata: {\"revision\":413}\n\nid: 419\nevent: bookmark\ndata: {\"revision\":419}\n\n";
        let (events, parser) = read(&[text]);
        assert_eq!(
            events,
            [
                event("change", "413", "{\"revision\":413}"),
                event("bookmark", "419", "{\"revision\":419}")
            ]
        );
        assert_eq!(parser.retry(), Some(Duration::from_millis(2731)));
    }

    #[test]
    fn the_rules_of_the_standard_hold() {
        for (text, expected) in [
            // Several lines of data, one space is taken away.
            ("data: a\ndata:  b\ndata\n\n", vec![event("message", "", "a\n b\n")]),
            // Comments, unknown fields, and an event without data.
            (": hello\nfoo: bar\nevent: x\n\ndata: y\n\n", vec![event("message", "", "y")]),
            // The id stays, also that of an event without data.
            (
                "id: 7\n\ndata: a\n\ndata: b\n\n",
                vec![event("message", "7", "a"), event("message", "7", "b")],
            ),
            ("id: 7\nid\ndata: a\n\n", vec![event("message", "", "a")]),
            ("id: 7\nid: 8\u{0}\ndata: a\n\n", vec![event("message", "7", "a")]),
            // All three ends of lines.
            (
                "data: a\r\n\r\ndata: b\r\rdata: c\n\n",
                vec![
                    event("message", "", "a"),
                    event("message", "", "b"),
                    event("message", "", "c"),
                ],
            ),
            // A byte order mark at the beginning, and an event that is not complete.
            ("\u{feff}data: a\n\ndata: b\n", vec![event("message", "", "a")]),
            ("data: a:b\n\n", vec![event("message", "", "a:b")]),
        ] {
            assert_eq!(read(&[text.as_bytes()]).0, expected, "{text:?}");
        }
        assert_eq!(read(&[b"retry: 1s\nretry: -1\nretry:\n\n"]).1.retry(), None);
    }

    #[test]
    fn what_is_too_large_is_refused() {
        let mut parser = Parser::default();
        let mut out = VecDeque::new();
        let chunk = vec![b'x'; 1024 * 1024];
        let mut taken = 0;
        while parser.push(&chunk, &mut out).is_ok() {
            taken += 1;
        }
        assert_eq!(taken, 16);
        let mut parser = Parser::default();
        let line = [b"data: ".as_slice(), &chunk, b"\n"].concat();
        let mut lines = 0;
        while parser.push(&line, &mut out).is_ok() {
            lines += 1;
        }
        assert_eq!(lines, 15);
        assert!(out.is_empty());
    }

    proptest! {
        /// However the network cuts a stream, the same events come out of it.
        #[test]
        fn chunks_do_not_matter(
            parts in prop::collection::vec(
                prop::sample::select(vec![
                    "data", ": ", ":", " ", "\n", "\r", "\r\n", "\n\n", "id", "event", "retry: 5",
                    "ä", "\u{feff}", "x", "7", "\0",
                ]),
                0..60,
            ),
            cuts in prop::collection::vec(0_usize..200, 0..20),
        ) {
            let text = parts.concat().into_bytes();
            let mut places: Vec<usize> = cuts.into_iter().map(|cut| cut.min(text.len())).collect();
            places.extend([0, text.len()]);
            places.sort_unstable();
            let chunks: Vec<&[u8]> =
                places.windows(2).map(|pair| &text[pair[0]..pair[1]]).collect();
            let (whole, one) = read(&[&text]);
            let (cut, many) = read(&chunks);
            prop_assert_eq!(whole, cut);
            prop_assert_eq!(one.retry(), many.retry());
        }

        /// Nothing that a server can send makes it panic.
        #[test]
        fn anything_is_taken(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
            let _ = read(&[&bytes]);
        }
    }
}
