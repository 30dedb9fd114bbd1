//! What each error code means and what to do: the pages that the `type` of a problem leads to.

use blaze_domain::config::Code;

/// Begin of every page.
const HEAD: &str = "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
    <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<title>";
/// Look of every page.
const STYLE: &str = "</title>\n<style>\nbody{font:16px/1.5 system-ui,sans-serif;max-width:44rem;margin:3rem auto;padding:0 1rem;color:#1b1f24}\n\
    h1{font-size:1.5rem}code{background:#f0f2f4;padding:.1rem .3rem;border-radius:.2rem}\n\
    dt{font-weight:600;margin-top:1rem}dd{margin:0}table{border-collapse:collapse}td,th{text-align:left;padding:.2rem 1rem .2rem 0}\n\
    @media(prefers-color-scheme:dark){body{background:#14171a;color:#e6e8ea}code{background:#262b30}a{color:#7ab7ff}}\n</style>\n</head>\n<body>\n";
const END: &str = "</body>\n</html>\n";
/// A section for each code.
const TEXTS: &str = include_str!("../../../../docs/config-errors.md");

/// What a code means, and what to do about it: its section of the documentation.
fn words(code: Code) -> (String, String) {
    let heading = format!("### `{code}`\n");
    let section = TEXTS.split_once(&heading).map_or("", |(_, rest)| rest);
    let section = section.split_once("\n#").map_or(section, |(own, _)| own);
    let (meaning, remedy) = section.split_once("**What to do.**").unwrap_or_default();
    // Its first paragraph is title and status, which the page has already.
    let meaning = meaning.trim_start().split_once("\n\n").map_or("", |(_, rest)| rest);
    (html(meaning), html(remedy))
}

/// A paragraph of Markdown that has nothing but text and code.
fn html(text: &str) -> String {
    let parts = escaped(text.trim());
    let mut out = String::new();
    for (index, part) in parts.split('`').enumerate() {
        match index % 2 {
            0 => out.push_str(part),
            _ => out.push_str(&format!("<code>{part}</code>")),
        }
    }
    out
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// The page of one code.
pub(super) fn page(code: Code) -> String {
    let (meaning, remedy) = words(code);
    let status = code
        .http_status()
        .map_or_else(|| "within a stream".to_owned(), |status| status.to_string());
    format!(
        "{HEAD}{code}{STYLE}<p><a href=\"/docs/errors\">All error codes</a></p>\n<h1><code>{code}</code></h1>\n<p>{}</p>\n<dl>\n\
         <dt>Status</dt><dd>{status}</dd>\n<dt>What it means</dt><dd>{meaning}</dd>\n<dt>What to do</dt><dd>{remedy}</dd>\n</dl>\n{END}",
        escaped(code.title()),
    )
}

/// The list of all codes.
pub(super) fn index() -> String {
    let rows: String = Code::ALL
        .iter()
        .map(|code| {
            let status =
                code.http_status().map_or_else(|| "–".to_owned(), |status| status.to_string());
            let title = escaped(code.title());
            format!(
                "<tr><td><a href=\"/docs/errors/{code}\"><code>{code}</code></a></td><td>{status}</td><td>{title}</td></tr>\n",
            )
        })
        .collect();
    format!(
        "{HEAD}Error codes{STYLE}<p><a href=\"/docs\">API</a></p>\n<h1>Error codes</h1>\n<table>\n\
         <tr><th>Code</th><th>Status</th><th>Title</th></tr>\n{rows}</table>\n{END}"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_has_a_page_of_its_own() {
        let index = index();
        let mut pages: Vec<String> = Code::ALL.iter().map(|code| page(*code)).collect();
        for (code, page) in Code::ALL.iter().zip(&pages) {
            assert!(page.contains(&format!("<h1><code>{code}</code>")), "{code}");
            let (meaning, remedy) = words(*code);
            assert!(!meaning.is_empty() && !remedy.is_empty(), "{code} has no words");
            assert!(
                !page.contains('`') && !page.contains("**"),
                "{code} has more than text and code"
            );
            assert!(index.contains(&format!("/docs/errors/{code}\"")), "{code}");
            assert!(
                !page.contains("http://") && !page.contains("https://"),
                "{code} leads elsewhere"
            );
        }
        pages.sort_unstable();
        pages.dedup();
        assert_eq!(pages.len(), Code::ALL.len());
        assert_eq!(TEXTS.matches("\n### ").count(), Code::ALL.len(), "a heading of no code");
    }
}
