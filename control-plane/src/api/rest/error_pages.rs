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

/// What a code means, and what to do about it.
fn words(code: Code) -> (&'static str, &'static str) {
    match code {
        Code::InvalidRequest => (
            "The body or a parameter cannot be read: it is no JSON or YAML, it gives a member twice, it holds an \
             integer outside ±(2^53−1), it is nested deeper than 32, or a parameter has a value of the wrong form.",
            "The detail names the place. Correct the request; sending the same again gives the same answer.",
        ),
        Code::InvalidHeader => (
            "A header has a value that cannot be used: an If-Match without quotes, an Idempotency-Key that is too \
             long, a Last-Event-ID that is no revision, a Host that comes twice or not at all.",
            "Send ETags as they came, with their quotes: If-Match: \"412\". An Idempotency-Key is 1 to 128 visible \
             ASCII characters.",
        ),
        Code::UnknownParameter => (
            "The query has a parameter that this path does not know, or one that comes twice. Nothing is ignored, so \
             that a slip cannot change what a request means.",
            "Compare with the list in the detail; parameters are lower case with underscores.",
        ),
        Code::InvalidPageToken => (
            "The page token was changed, or comes from a list with other filters.",
            "Repeat every parameter of the first page together with next_page_token, or list again from the start.",
        ),
        Code::InvalidLabelSelector => (
            "The label selector cannot be read.",
            "Join requirements with commas: site=lab, tier!=test, zone in (a,b), zone notin (c), canary, !spare. In a \
             query, encode blanks and commas within parentheses.",
        ),
        Code::Unauthenticated => (
            "There is no token, or it is not accepted. The answer is the same for every cause; the log and the audit \
             of the service say which one it was.",
            "Send Authorization: Bearer TOKEN. Look at the token with blaze token inspect: has it run out, is it of \
             another issuer or audience, was it revoked?",
        ),
        Code::PermissionDenied => (
            "The token is good and does not allow this: its role is too weak, or it is bound to a layer and this is \
             outside of that layer's view, whether it exists or not. With --dev it also means that the request came \
             under another name than localhost.",
            "Use a token with the role that the detail names. An administrator makes one with blaze token create.",
        ),
        Code::NotFound => (
            "There is no such document, token, revision or path. Paths are exact: lower case, no slash at the end, no \
             percent-encoding.",
            "Look at the list of the collection, or at /docs for the paths.",
        ),
        Code::MethodNotAllowed => (
            "The path exists and does not take this method.",
            "The header Allow names the methods that it takes.",
        ),
        Code::NotAcceptable => (
            "The header Accept excludes every type that the path can give.",
            "Accept application/json, or text/event-stream for a watch, or leave the header out.",
        ),
        Code::AlreadyExists => (
            "A document of that name exists, and POST makes only new ones.",
            "Read it and change it with PUT or PATCH and If-Match, or choose another name.",
        ),
        Code::InUse => (
            "Other documents refer to the one that is to be deleted; the detail names some of them, as far as the token \
             sees them.",
            "Delete them first, or all at once with ?cascade=true.",
        ),
        Code::RevisionConflict => (
            "A document of the request has another revision than the request says, or was changed after the commit \
             that is to be reverted.",
            "Read the documents again and decide anew. A revert with \"force\": true overwrites what came after.",
        ),
        Code::RolloutActive => (
            "The target has a roll-out that has not ended.",
            "Promote or abort that one first.",
        ),
        Code::RolloutState => (
            "The roll-out has ended, or its spec would change after it began.",
            "Look at its status. Only a roll-out in phase canary is promoted or aborted; to change one, abort it and \
             start another.",
        ),
        Code::IdempotencyInProgress => (
            "The first request with this Idempotency-Key is still running.",
            "Send the same again after a second: it gets the first answer.",
        ),
        Code::SigningDisabled => (
            "The service has no key to sign tokens with.",
            "Set sign: true at a key of control_plane.auth.keys, or sign tokens elsewhere: blaze token create \
             --key-file.",
        ),
        Code::LimitExceeded => (
            "A limit of the system is reached: 100,000 documents, or a prune of more than 20 documents without \
             prune_confirm.",
            "The detail names the limit and the count. Give exactly that count in prune_confirm if it is meant.",
        ),
        Code::RevisionTrimmed => (
            "The history no longer reaches back to that revision.",
            "List again, then watch from the revision of the list. oldest_revision is the smallest one that a watch \
             may start after.",
        ),
        Code::RevisionUnknown => (
            "The store has not reached that revision: it belongs to another store, or to a time before a backup was \
             restored.",
            "List again, and go on from the revision of the list.",
        ),
        Code::PreconditionFailed => (
            "The document was changed, deleted or made since it was read, so that If-Match or If-None-Match does not \
             hold. Nothing was written.",
            "Read it again, apply the change to what is there now, and send it with the new ETag.",
        ),
        Code::PayloadTooLarge => (
            "The body, a document or the number of documents is over its limit: 1 MiB for a body (8 MiB for apply), \
             256 KiB for a document, 1,000 documents for an apply.",
            "Send less at once.",
        ),
        Code::UriTooLong => (
            "Path and query have more than 8 KiB.",
            "Shorten the query; a long label selector can often use in (…).",
        ),
        Code::UnsupportedMediaType => (
            "The body has a Content-Type that this path does not take, or none.",
            "Send application/json; PATCH takes application/merge-patch+json too, and apply takes application/yaml. \
             The charset is UTF-8.",
        ),
        Code::ValidationFailed => (
            "The document breaks a rule: an unknown member, a missing one, a value of the wrong type, a name that is \
             not allowed, a schema that refers to itself at the same value. Or what it makes cannot be checked in \
             reasonable time: a configuration that is too large for its schema, a change that touches too many effective \
             configurations of services with a schema at once.",
            "errors lists up to 100 faults, each with its place as a JSON pointer. What is too costly to check is made \
             smaller, its schema simpler, or the change in parts.",
        ),
        Code::SchemaMismatch => (
            "With this change the effective configuration of a service would no longer match the service's JSON \
             Schema. Nothing was written.",
            "errors names the first twenty faults (the first one alone, where the check takes long). Correct the value, \
             or change the schema first.",
        ),
        Code::ReferenceNotFound => (
            "The document refers to one that does not exist: the layer of a node, the service of an instance, the \
             target of a roll-out.",
            "Make it first, or write both in one apply; the order does not matter there.",
        ),
        Code::SecretUnknown => (
            "The document keeps a secret ({\"redacted\": true}) at a place where none is stored, or in an item of a list \
             that was changed so that it is not clear which item of before it is.",
            "Write the secret's text: {\"$secret\": \"text\"}.",
        ),
        Code::IdempotencyKeyReused => (
            "The Idempotency-Key was used in the last 24 hours for a request with another body.",
            "Take a new key for every new request; repeat a key only to repeat the very same request.",
        ),
        Code::PreconditionRequired => (
            "The document exists, and a change must say which revision it is of, so that nobody overwrites what they \
             have not seen.",
            "Send If-Match with the ETag of the document, or If-Match: * to overwrite whatever is there.",
        ),
        Code::RateLimited => (
            "There were too many requests of this subject, too many refused tokens from this address, or too many open \
             watches of this subject.",
            "Wait as long as Retry-After says. The limits are in control_plane.limits of the node file.",
        ),
        Code::HeadersTooLarge => (
            "The headers have more than 32 KiB. Beyond 64 KiB, or 1,024 lines over HTTP/1.1, the connection is closed \
             with a bare 431.",
            "Look for a cookie or a token that has grown.",
        ),
        Code::WatchTooSlow => (
            "The watcher was more than 1,000 events or 8 MiB behind, and the stream was ended so that it does not \
             hold memory for others. This comes within a stream alone.",
            "Connect again with Last-Event-ID; take events off the stream faster than they come.",
        ),
        Code::Internal => (
            "The service failed at this request. That is a fault of the service.",
            "Look for the request_id in its log. Whether a write took effect is told by applied; if it says unknown, \
             read before trying again.",
        ),
        Code::StoreUnavailable => (
            "The store cannot be reached. Nothing was written.",
            "Try again after Retry-After. Reads with consistency=cached work without the store.",
        ),
        Code::OutcomeUnknown => (
            "The store did not say whether the write took effect, and could not be asked.",
            "Read the document before trying again. With an Idempotency-Key the same request can be sent again \
             safely.",
        ),
        Code::Overloaded => (
            "The service works on as many requests, or receives as many bytes of bodies, as it may. Nothing was \
             written.",
            "Try again after Retry-After, with growing pauses.",
        ),
        Code::ShuttingDown => (
            "The service is ending.",
            "Connect again: to another process, or to this one once it is back. A watch goes on with Last-Event-ID.",
        ),
        Code::DeadlineExceeded => (
            "There was no answer within 30 seconds, or the body did not come to its end in that time.",
            "Read before trying a write again: applied says unknown where it may have taken effect.",
        ),
    }
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

/// The page of one code.
pub(super) fn page(code: Code) -> String {
    let (meaning, remedy) = words(code);
    let status = code
        .http_status()
        .map_or_else(|| "within a stream".to_owned(), |status| status.to_string());
    format!(
        "{HEAD}{code}{STYLE}<p><a href=\"/docs/errors\">All error codes</a></p>\n<h1><code>{code}</code></h1>\n<p>{}</p>\n<dl>\n\
         <dt>Status</dt><dd>{status}</dd>\n<dt>What it means</dt><dd>{}</dd>\n<dt>What to do</dt><dd>{}</dd>\n</dl>\n{END}",
        escaped(code.title()),
        escaped(meaning),
        escaped(remedy),
    )
}

/// The list of all codes.
pub(super) fn index() -> String {
    let rows: String = Code::ALL
        .iter()
        .map(|code| {
            let status = code.http_status().map_or_else(|| "–".to_owned(), |status| status.to_string());
            let title = escaped(code.title());
            format!("<tr><td><a href=\"/docs/errors/{code}\"><code>{code}</code></a></td><td>{status}</td><td>{title}</td></tr>\n")
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
            assert!(page.contains(&format!("<code>{code}</code>")), "{code}");
            assert!(index.contains(&format!("/docs/errors/{code}\"")), "{code}");
            assert!(
                !page.contains("http://") && !page.contains("https://"),
                "{code} leads elsewhere"
            );
        }
        pages.sort_unstable();
        pages.dedup();
        assert_eq!(pages.len(), Code::ALL.len());
    }
}
