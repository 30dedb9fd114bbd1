//! History, audit, answers to repeat, tokens.

use blaze_domain::config::Timestamp;

use super::Fixture;
use super::samples::{self, answer, audit, record, time, token};
use super::tools::{Model, commit, fresh};
use blaze_config::store::upkeep::now;
use blaze_config::store::{AuditEntry, AuditQuery, FullStore, Op, TokenRecord};

/// The history of a document is read newest first, in pages, also after its deletion, and never
/// holds another one's.
pub async fn versions_come_newest_first(fixture: &dyn Fixture) {
    let mut model = Model::new(fixture, "versions").await;
    // Names that begin alike must not be mixed up.
    model.write(&[&["a", "a-b", "ab"], &["a"], &["-a", "ab"], &["a"], &["a-b"]]).await;
    let key = samples::key("a");
    let all = model.store.versions(&key, None, 10).await.unwrap();
    let seen: Vec<(u64, Op, Option<u64>)> = all
        .iter()
        .map(|version| (version.revision, version.change.op, version.change.previous))
        .collect();
    let expected = vec![
        (4, Op::Create, None),
        (3, Op::Delete, Some(2)),
        (2, Op::Update, Some(1)),
        (1, Op::Create, None),
    ];
    assert_eq!(seen, expected, "revision, change and version before");
    for version in &all {
        let commit = &model.commits[usize::try_from(version.revision - 1).unwrap()];
        let change = commit.changes.iter().find(|change| change.document.key == key);
        assert_eq!(Some(&version.change), change, "the change of a version");
        let found = (version.time, &version.subject, &version.request_id);
        assert_eq!(found, (commit.time, &commit.subject, &commit.request_id));
    }
    let page = model.store.versions(&key, Some(4), 2).await.unwrap();
    assert_eq!(page.as_slice(), &all[1..3], "a page below 4");
    assert_eq!(model.store.versions(&key, Some(1), 9).await.unwrap().len(), 0, "below 1");
    let unknown = model.store.versions(&samples::key("z"), None, 9).await.unwrap();
    assert_eq!(unknown.len(), 0, "versions of an unknown document");
    // The page begins in the middle of commits that were written together, with later changes of
    // the same document.
    model.write(&[&["b"]]).await;
    model.write(&[&["ab"], &["b"], &["b"], &["ab"]]).await;
    for (below, limit, expected) in
        [(8, 1, vec![6]), (9, 1, vec![8]), (9, 2, vec![8, 6]), (8, 9, vec![6])]
    {
        let page = model.store.versions(&samples::key("b"), Some(below), limit).await.unwrap();
        let page: Vec<u64> = page.iter().map(|version| version.revision).collect();
        assert_eq!(page, expected, "{limit} below {below}");
    }
}

/// The newest revision before a time is found.
pub async fn revisions_before_a_time_are_found(fixture: &dyn Fixture) {
    let mut model = Model::new(fixture, "before").await;
    assert_eq!(model.store.revision_before(now()).await.unwrap(), 0, "in an empty store");
    for _ in 0..9 {
        model.write(&[&["a"]]).await;
    }
    for (before, expected) in
        [(time(0), 0), (time(1), 0), (time(2), 1), (time(9), 8), (time(10), 9), (time(99), 9)]
    {
        let found = model.store.revision_before(before).await.unwrap();
        assert_eq!(found, expected, "the revision before {before}");
    }
    model.store.trim(4, 1).await.unwrap();
    for (before, expected) in [(time(3), 0), (time(6), 5), (time(99), 9)] {
        let found = model.store.revision_before(before).await.unwrap();
        assert_eq!(found, expected, "the revision before {before}, trimmed to 4");
    }
}

/// What a query asks for.
type Holds = fn(&AuditEntry) -> bool;

/// Each filter of the audit holds, entries come newest first, and pages neither overlap nor leave
/// one out.
pub async fn audit_is_filtered_and_paged(fixture: &dyn Fixture) {
    let store = fresh(fixture, "audit").await;
    let mut entries: Vec<AuditEntry> = (0..20).map(entry).collect();
    store.append_audit(&entries).await.unwrap();
    entries.reverse();
    let asked = |set: fn(&mut AuditQuery)| {
        let mut query = AuditQuery { limit: 100, ..AuditQuery::default() };
        set(&mut query);
        query
    };
    let queries: [(AuditQuery, Holds); 7] = [
        (asked(|_| ()), |_| true),
        (asked(|query| query.subject = Some("eve".to_owned())), |entry| entry.subject == "eve"),
        (asked(|query| query.action = Some("reveal".to_owned())), |entry| entry.action == "reveal"),
        (asked(|query| query.allowed = Some(false)), |entry| !entry.allowed),
        (asked(|query| query.kind = Some("Node".to_owned())), |entry| {
            entry.key.as_ref().is_some_and(|key| key.kind().as_str() == "Node")
        }),
        (asked(|query| query.name = Some("n3".to_owned())), |entry| {
            entry.key.as_ref().is_some_and(|key| key.name().as_str() == "n3")
        }),
        (
            asked(|query| (query.since, query.until) = (Some(audit_time(5)), Some(audit_time(9)))),
            |entry| entry.time >= audit_time(5) && entry.time < audit_time(9),
        ),
    ];
    for (query, holds) in queries {
        let found = store.audit(&query).await.unwrap();
        let expected: Vec<AuditEntry> =
            entries.iter().filter(|entry| holds(entry)).cloned().collect();
        assert_eq!(found, expected, "{query:?}");
    }
    assert_eq!(pages(store.as_ref(), 3).await, entries, "all pages");
}

/// Not long ago, so that it is not taken for old.
fn audit_time(number: u64) -> Timestamp {
    static START: std::sync::OnceLock<i64> = std::sync::OnceLock::new();
    let start = START.get_or_init(|| now().as_millis() - 60_000);
    Timestamp::from_millis(start + i64::try_from(number).unwrap_or(0) * 1_000)
}

/// With what ids of this time begin, the same for all of a test.
fn id_time() -> String {
    static TIME: std::sync::OnceLock<String> = std::sync::OnceLock::new();
    let make = || uuid::Uuid::now_v7().to_string().chars().take(8).collect();
    TIME.get_or_init(make).clone()
}

fn entry(number: u64) -> AuditEntry {
    let done = number.is_multiple_of(2);
    let mut entry = audit(
        if number.is_multiple_of(3) { "reveal" } else { "update" },
        done.then_some(number + 1),
    );
    entry.time = audit_time(number);
    entry.id = format!("{}-{number:04}-{}", id_time(), entry.id);
    entry.subject = if number < 4 { "eve" } else { "" }.to_owned();
    entry.key = match number % 5 {
        0 => None,
        4 => entry.key,
        other => Some(samples::key(&format!("n{other}"))),
    };
    entry
}

/// Who does not know whether an entry was written may write it again.
pub async fn audit_written_twice_is_there_once(fixture: &dyn Fixture) {
    let store = fresh(fixture, "audit-twice").await;
    let entries = [entry(1), entry(2), entry(3)];
    store.append_audit(&entries[..2]).await.unwrap();
    store.append_audit(&entries).await.unwrap();
    store.append_audit(&[]).await.unwrap();
    let query = AuditQuery { limit: 10, ..AuditQuery::default() };
    assert_eq!(store.audit(&query).await.unwrap().len(), 3, "entries");
}

/// Entries of commits and others are one audit, newest first by their ids, also where ids do not
/// follow revisions, and whatever of it is trimmed.
pub async fn audit_of_commits_is_among_the_rest(fixture: &dyn Fixture) {
    let mut model = Model::new(fixture, "merged").await;
    let mut all = Vec::new();
    for number in 0..12_u64 {
        let mut written = model.record(&["a"]);
        // Two to each commit, which overlap with those of commits before and after.
        written.audit = [number, number + 1].map(entry).to_vec();
        for (place, entry) in (0..).zip(&mut written.audit) {
            entry.revision = Some(number + 1);
            entry.id = format!("{}-{:04}-{number}-{place}", id_time(), number * 7 % 30 + place * 4);
        }
        all.extend(written.audit.clone());
        commit(model.store.as_ref(), &[written]).await;
        let apart = entry(number);
        model.store.append_audit(std::slice::from_ref(&apart)).await.unwrap();
        all.push(apart);
    }
    all.sort_by(|one, other| other.id.cmp(&one.id));
    for floor in [0, 5, 12] {
        model.store.trim(floor, 1).await.unwrap();
        model.store.tidy().await.unwrap();
        for limit in [1, 4, 100] {
            let found = pages(model.store.as_ref(), limit).await;
            assert_eq!(found, all, "pages of {limit}, floor {floor}");
        }
        let query = AuditQuery {
            subject: Some("eve".to_owned()),
            allowed: Some(true),
            limit: 100,
            ..AuditQuery::default()
        };
        let found = model.store.audit(&query).await.unwrap();
        let expected = all.iter().filter(|entry| entry.subject == "eve" && entry.allowed);
        assert_eq!(found, expected.cloned().collect::<Vec<_>>(), "entries of one subject");
    }
}

/// All of the audit, in pages.
async fn pages(store: &dyn FullStore, limit: usize) -> Vec<AuditEntry> {
    let mut paged: Vec<AuditEntry> = Vec::new();
    loop {
        let query = AuditQuery {
            below: paged.last().map(|entry| entry.id.clone()),
            limit,
            ..AuditQuery::default()
        };
        let page = store.audit(&query).await.unwrap();
        if page.is_empty() {
            return paged;
        }
        paged.extend(page);
    }
}

/// An answer is found until its time, and not after it, even while it is still stored.
pub async fn answers_are_kept_until_they_expire(fixture: &dyn Fixture) {
    let store = fresh(fixture, "expiry").await;
    let mut written = record(samples::commit(1, &["a"]));
    let kept = answer("one", 1);
    let expires = kept.expires;
    written.idempotency = Some(kept.clone());
    commit(store.as_ref(), &[written]).await;
    let before = Timestamp::from_millis(expires.as_millis() - 1);
    assert_eq!(store.idempotency("one", before).await.unwrap(), Some(kept), "just before");
    assert_eq!(store.idempotency("one", expires).await.unwrap(), None, "at its end");
    assert_eq!(store.idempotency("two", before).await.unwrap(), None, "another id");
}

/// Tokens are listed newest first until they expire; the first revocation stays; each has its audit
/// entry.
pub async fn tokens_are_kept_and_revoked(fixture: &dyn Fixture) {
    let store = fresh(fixture, "tokens").await;
    let start = now().as_millis();
    let tokens: Vec<TokenRecord> = ["one", "two", "three"]
        .into_iter()
        .zip([0, 1, 2])
        .map(|(id, later)| {
            let mut token = token(id);
            token.create_time = Timestamp::from_millis(start + later);
            token
        })
        .collect();
    for token in &tokens {
        store.add_token(token, &audit("token_create", None)).await.unwrap();
    }
    let mut expected: Vec<TokenRecord> = tokens.clone();
    expected.reverse();
    assert_eq!(store.tokens(now()).await.unwrap(), expected, "the tokens");
    let times = [start + 500, start + 900].map(Timestamp::from_millis);
    for time in times {
        let found = store.revoke_token("two", time, &audit("token_revoke", None)).await.unwrap();
        assert!(found, "that there is a token of that id");
    }
    for token in &mut expected {
        token.revoke_time = (token.id == "two").then_some(Timestamp::from_millis(start + 500));
    }
    assert_eq!(store.tokens(now()).await.unwrap(), expected, "the tokens");
    let found = store.revoke_token("four", now(), &audit("token_revoke", None)).await.unwrap();
    assert!(!found, "that there is a token that was never made");
    let later = Timestamp::from_millis(start + 3_600_000 * 2);
    assert_eq!(store.tokens(later).await.unwrap().len(), 0, "tokens when all have expired");
    for (action, count) in [("token_create", 3), ("token_revoke", 2)] {
        let query =
            AuditQuery { action: Some(action.to_owned()), limit: 10, ..AuditQuery::default() };
        assert_eq!(store.audit(&query).await.unwrap().len(), count, "entries of {action}");
    }
}
