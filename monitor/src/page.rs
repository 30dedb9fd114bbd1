//! `/metrics?all=1`: the pages of all programs of the node as one, so that one target a node is
//! enough. Each series has the label of its program.

use std::collections::BTreeMap;

/// Pages of several programs, merged: each family is there once.
#[derive(Debug, Default)]
pub struct Merged {
    families: BTreeMap<String, Family>,
    /// Samples whose family has another type elsewhere.
    refused: u64,
}

#[derive(Debug, Default)]
struct Family {
    help: String,
    kind: String,
    lines: Vec<String>,
}

impl Merged {
    /// Adds the page of a program. `labels` go before those of each series, as
    /// `program="blaze-flow"`; of a name that the series has itself, the series' own is renamed
    /// `exported_…`, as Prometheus does it. A family whose type differs from that of another page
    /// is left out, since one page can have only one of them.
    pub fn add(&mut self, page: &str, labels: &[(&str, &str)]) {
        let (mut name, mut help, mut kind) = (String::new(), String::new(), String::new());
        for line in page.lines() {
            if let Some(rest) = line.strip_prefix("# HELP ") {
                let (of, text) = rest.split_once(' ').unwrap_or((rest, ""));
                (name, help, kind) = (of.to_owned(), text.to_owned(), "untyped".to_owned());
            } else if let Some(rest) = line.strip_prefix("# TYPE ") {
                let (of, text) = rest.split_once(' ').unwrap_or((rest, "untyped"));
                if of != name {
                    (name, help) = (of.to_owned(), String::new());
                }
                kind = text.to_owned();
            } else if !line.starts_with('#') && !line.is_empty() {
                let Some(sample) = Sample::of(line) else {
                    self.refused += 1;
                    continue;
                };
                let (of, help, kind) = match sample.is_of(&name) {
                    true => (name.as_str(), help.as_str(), kind.as_str()),
                    false => (sample.name, "", "untyped"),
                };
                match sample.labelled(labels) {
                    Some(line) => self.sample(of, help, kind, line),
                    None => self.refused += 1,
                }
            }
        }
    }

    fn sample(&mut self, family: &str, help: &str, kind: &str, line: String) {
        let entry = self.families.entry(family.to_owned()).or_default();
        if entry.lines.is_empty() {
            (entry.help, entry.kind) = (help.to_owned(), kind.to_owned());
        }
        match entry.kind == kind {
            true => entry.lines.push(line),
            false => self.refused += 1,
        }
    }

    /// Samples that are not on the page: their family has another type elsewhere, or they are none.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// The page.
    #[must_use]
    pub fn text(&self) -> String {
        let mut out = String::new();
        for (name, family) in &self.families {
            if !family.help.is_empty() {
                out.push_str(&format!("# HELP {name} {}\n", family.help));
            }
            out.push_str(&format!("# TYPE {name} {}\n", family.kind));
            for line in &family.lines {
                out.push_str(line);
                out.push('\n');
            }
        }
        out
    }
}

/// A line with a value.
struct Sample<'a> {
    name: &'a str,
    /// Without braces.
    labels: &'a str,
    /// Names of the labels.
    names: Vec<&'a str>,
    /// With the space before it.
    value: &'a str,
}

impl<'a> Sample<'a> {
    /// `None` where Prometheus would refuse the line, and with it the whole page.
    fn of(line: &'a str) -> Option<Self> {
        let end = line.find(['{', ' '])?;
        let (name, rest) = line.split_at(end);
        let (labels, value) = match rest.strip_prefix('{') {
            None => ("", rest),
            Some(inner) => {
                let close = closing(inner)?;
                (inner[..close].trim_end_matches(','), &inner[close + 1..])
            }
        };
        // What follows is an exemplar of OpenMetrics, which this format does not have.
        let value = value.split(" # ").next().unwrap_or_default();
        let names = label_names(labels)?;
        (is_name(name) && is_value(value)).then_some(Self { name, labels, names, value })
    }

    /// Whether it belongs to a family: histograms and summaries have lines with suffixes.
    fn is_of(&self, family: &str) -> bool {
        let suffix = self.name.strip_prefix(family);
        suffix.is_some_and(|suffix| matches!(suffix, "" | "_bucket" | "_sum" | "_count" | "_total"))
    }

    /// The line with more labels; an own one of such a name is renamed `exported_…`, as Prometheus
    /// does it. `None`: two labels would have one name.
    fn labelled(&self, more: &[(&str, &str)]) -> Option<String> {
        let mut labels = Vec::new();
        let mut own = self.labels.to_owned();
        let mut names = self.names.clone();
        let renames: Vec<String> =
            more.iter().map(|(name, _)| format!("exported_{name}")).collect();
        for ((name, value), renamed) in more.iter().zip(&renames) {
            let label = format!("{name}={value:?}");
            if label_at(&own, name).is_some_and(|rest| rest.starts_with(&label)) {
                continue;
            }
            if let Some(at) = names.iter().position(|known| known == name) {
                own = exported(&own, name);
                names[at] = renamed;
            }
            names.push(name);
            labels.push(label);
        }
        if !own.is_empty() {
            labels.push(own);
        }
        names.sort_unstable();
        let are_different = names.windows(2).all(|pair| pair[0] != pair[1]);
        are_different.then(|| format!("{}{{{}}}{}", self.name, labels.join(","), self.value))
    }
}

/// Names of labels; `None` where they are not `name="value"` with commas between.
fn label_names(labels: &str) -> Option<Vec<&str>> {
    let mut names = Vec::new();
    let mut rest = labels;
    while !rest.is_empty() {
        let (name, after) = rest.split_once('=')?;
        let value = after.strip_prefix('"')?;
        let end = end_of_value(value)?;
        is_name(name).then(|| names.push(name))?;
        rest = &value[end + 1..];
        rest = match rest.strip_prefix(',') {
            Some(next) if !next.is_empty() => next,
            None if rest.is_empty() => rest,
            _ => return None,
        };
    }
    Some(names)
}

/// Where the quote is that ends a value.
fn end_of_value(value: &str) -> Option<usize> {
    let mut is_escaped = false;
    value.bytes().position(|byte| match (is_escaped, byte) {
        (true, _) => {
            is_escaped = false;
            false
        }
        (false, b'\\') => {
            is_escaped = true;
            false
        }
        (false, byte) => byte == b'"',
    })
}

fn is_name(name: &str) -> bool {
    let is_of_name = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'_' | b':');
    name.bytes().all(is_of_name) && name.bytes().next().is_some_and(|first| !first.is_ascii_digit())
}

/// A number, and perhaps the time in milliseconds.
fn is_value(text: &str) -> bool {
    let mut words = text.split_ascii_whitespace();
    text.starts_with(' ')
        && words.next().is_some_and(|number| number.parse::<f64>().is_ok())
        && words.next().is_none_or(|time| time.parse::<i64>().is_ok())
        && words.next().is_none()
}

/// Where the labels end: the first brace outside of a value.
fn closing(inner: &str) -> Option<usize> {
    outside_of_values(inner).find(|(_, byte)| *byte == b'}').map(|(at, _)| at)
}

/// Bytes with their positions, without those of values.
fn outside_of_values(text: &str) -> impl Iterator<Item = (usize, u8)> {
    let (mut is_within, mut is_escaped) = (false, false);
    text.bytes().enumerate().filter(move |(_, byte)| {
        let was_within = is_within;
        match (is_within, is_escaped, byte) {
            (true, true, _) => is_escaped = false,
            (true, false, b'\\') => is_escaped = true,
            (_, _, b'"') => is_within = !is_within,
            _ => {}
        }
        !was_within
    })
}

/// The labels from the one of a name on.
fn label_at<'a>(labels: &'a str, name: &str) -> Option<&'a str> {
    let commas = outside_of_values(labels).filter(|(_, byte)| *byte == b',');
    let starts = std::iter::once(0).chain(commas.map(|(at, _)| at + 1));
    let mut rests = starts.map(|at| &labels[at..]);
    rests.find(|rest| rest.strip_prefix(name).is_some_and(|rest| rest.starts_with('=')))
}

/// The labels with one of a name renamed.
fn exported(labels: &str, name: &str) -> String {
    match label_at(labels, name) {
        Some(rest) => {
            format!("{}exported_{rest}", &labels[..labels.len() - rest.len()])
        }
        None => labels.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pages_are_merged_by_family_and_each_series_has_its_program() {
        let mut merged = Merged::default();
        merged.add(
            "# HELP a_total A.\n# TYPE a_total counter\na_total 1\na_total{x=\"}\\\",y\"} 2\n\
             # TYPE h histogram\nh_bucket{le=\"+Inf\"} 1\nh_sum 0.5\nh_count 1\n",
            &[("program", "blaze-flow")],
        );
        merged.add(
            "# HELP a_total A.\n# TYPE a_total counter\na_total{program=\"own\",z=\"1\"} 3\n\
             a_total{z=\"2\",program=\"blaze-worker\"} 4\n# TYPE h gauge\nh 1\nstray 4 1700000000000\n",
            &[("program", "blaze-worker")],
        );
        assert_eq!(
            merged.text(),
            "# HELP a_total A.\n# TYPE a_total counter\n\
             a_total{program=\"blaze-flow\"} 1\n\
             a_total{program=\"blaze-flow\",x=\"}\\\",y\"} 2\n\
             a_total{program=\"blaze-worker\",exported_program=\"own\",z=\"1\"} 3\n\
             a_total{z=\"2\",program=\"blaze-worker\"} 4\n\
             # TYPE h histogram\nh_bucket{program=\"blaze-flow\",le=\"+Inf\"} 1\n\
             h_sum{program=\"blaze-flow\"} 0.5\nh_count{program=\"blaze-flow\"} 1\n\
             # TYPE stray untyped\nstray{program=\"blaze-worker\"} 4 1700000000000\n"
        );
        assert_eq!(merged.refused(), 1);
    }

    #[test]
    fn a_line_that_would_spoil_the_page_is_left_out() {
        for (line, is_kept) in [
            ("a 1", true),
            ("a{x=\"1\"} 1 # {t=\"x\"} 1", true),
            ("a{exported_program=\"0\",program=\"1\"} 1", false),
            ("a{x=\"1\",x=\"2\"} 1", false),
            ("a foo", false),
            ("a 1 2 3", false),
            ("a-b 1", false),
            ("{\"json\":1} 5", false),
            ("a{x=1} 5", false),
            ("a{x=\"1\" y=\"2\"} 5", false),
        ] {
            let mut merged = Merged::default();
            merged.add(line, &[("program", "p")]);
            assert_eq!(merged.refused() == 0, is_kept, "{line}: {}", merged.text());
        }
    }

    #[test]
    fn what_is_no_page_does_no_harm() {
        let mut merged = Merged::default();
        merged.add(
            "\u{0}\n{\nx{y=\"\nx{\"}\n<html>\nNot Found\n1a 1\n# TYPE\n# HELP\n",
            &[("program", "p")],
        );
        assert_eq!(merged.text(), "");
        assert_eq!(merged.refused(), 7);
    }
}
