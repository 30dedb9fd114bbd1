//! History, audit, answers to repeat, tokens.

use blaze_domain::config::Timestamp;

use super::Fixture;
use super::samples::{self, answer, audit, record, time, token};
use super::tools::{Model, Outcome, commit, fresh, same, told};
use blaze_config::store::upkeep::now;
use blaze_config::store::{AuditEntry, AuditQuery, FullStore, Op, TokenRecord};

/// The history of a document is read newest first, in pages, also after its deletion, and never holds another one's.
///
/// # Errors
/// How the store breaks the rule.
pub async fn versions_come_newest_first(fixture: &dyn Fixture) -> Outcome {
    let mut model = Model::new(fixture, "versions").await?;
    // Names that begin alike must not be mixed up.
    model
        .write(&[&["a", "a-b", "ab"], &["a"], &["-a", "ab"], &["a"], &["a-b"]])
        .await?;
    let key = samples::key("a");
    let all = told("versions", model.store.versions(&key, None, 10).await)?;
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
    same("revision, change and version before", &seen, &expected)?;
    for version in &all {
        let commit = usize::try_from(version.revision - 1)
            .ok()
            .and_then(|place| model.commits.get(place));
        let change = commit.and_then(|commit| commit.changes.iter().find(|change| change.document.key == key));
        same("the change of a version", &Some(&version.change), &change)?;
        same(
            "time, subject and request of a version",
            &Some((version.time, version.subject.as_str(), version.request_id.as_str())),
            &commit.map(|commit| (commit.time, commit.subject.as_str(), commit.request_id.as_str())),
        )?;
    }
    let page = told("versions", model.store.versions(&key, Some(4), 2).await)?;
    same("a page below 4", &page.as_slice(), &all.get(1..3).unwrap_or_default())?;
    same(
        "below 1",
        &told("versions", model.store.versions(&key, Some(1), 9).await)?.len(),
        &0,
    )?;
    let unknown = told("versions", model.store.versions(&samples::key("z"), None, 9).await)?;
    same("versions of an unknown document", &unknown.len(), &0)?;
    // The page begins in the middle of commits that were written together, with later changes of the same document.
    model.write(&[&["b"]]).await?;
    model.write(&[&["ab"], &["b"], &["b"], &["ab"]]).await?;
    for (below, limit, expected) in [(8, 1, vec![6]), (9, 1, vec![8]), (9, 2, vec![8, 6]), (8, 9, vec![6])] {
        let page = model.store.versions(&samples::key("b"), Some(below), limit).await;
        let page = told("versions", page)?;
        let page: Vec<u64> = page.iter().map(|version| version.revision).collect();
        same(&format!("{limit} below {below}"), &page, &expected)?;
    }
    Ok(())
}

/// The newest revision before a time is found.
///
/// # Errors
/// How the store breaks the rule.
pub async fn revisions_before_a_time_are_found(fixture: &dyn Fixture) -> Outcome {
    let mut model = Model::new(fixture, "before").await?;
    same(
        "in an empty store",
        &told("revision_before", model.store.revision_before(now()).await)?,
        &0,
    )?;
    for _ in 0..9 {
        model.write(&[&["a"]]).await?;
    }
    for (before, expected) in [
        (time(0), 0),
        (time(1), 0),
        (time(2), 1),
        (time(9), 8),
        (time(10), 9),
        (time(99), 9),
    ] {
        let found = told("revision_before", model.store.revision_before(before).await)?;
        same(&format!("the revision before {before}"), &found, &expected)?;
    }
    told("trim", model.store.trim(4, 1).await)?;
    for (before, expected) in [(time(3), 0), (time(6), 5), (time(99), 9)] {
        let found = told("revision_before", model.store.revision_before(before).await)?;
        same(
            &format!("the revision before {before}, trimmed to 4"),
            &found,
            &expected,
        )?;
    }
    Ok(())
}

/// What a query asks for.
type Holds = fn(&AuditEntry) -> bool;

/// Each filter of the audit holds, entries come newest first, and pages neither overlap nor leave one out.
///
/// # Errors
/// How the store breaks the rule.
pub async fn audit_is_filtered_and_paged(fixture: &dyn Fixture) -> Outcome {
    let store = fresh(fixture, "audit").await?;
    let mut entries: Vec<AuditEntry> = (0..20).map(entry).collect();
    told("append_audit", store.append_audit(&entries).await)?;
    entries.reverse();
    let none = AuditQuery {
        limit: 100,
        ..AuditQuery::default()
    };
    let queries: Vec<(AuditQuery, Holds)> = vec![
        (none.clone(), |_| true),
        (
            AuditQuery {
                subject: Some("eve".to_owned()),
                ..none.clone()
            },
            |entry| entry.subject == "eve",
        ),
        (
            AuditQuery {
                action: Some("reveal".to_owned()),
                ..none.clone()
            },
            |entry| entry.action == "reveal",
        ),
        (
            AuditQuery {
                allowed: Some(false),
                ..none.clone()
            },
            |entry| !entry.allowed,
        ),
        (
            AuditQuery {
                kind: Some("Node".to_owned()),
                ..none.clone()
            },
            |entry| entry.key.as_ref().is_some_and(|key| key.kind().as_str() == "Node"),
        ),
        (
            AuditQuery {
                name: Some("n3".to_owned()),
                ..none.clone()
            },
            |entry| entry.key.as_ref().is_some_and(|key| key.name().as_str() == "n3"),
        ),
        (
            AuditQuery {
                since: Some(audit_time(5)),
                until: Some(audit_time(9)),
                ..none.clone()
            },
            |entry| entry.time >= audit_time(5) && entry.time < audit_time(9),
        ),
    ];
    for (query, holds) in queries {
        let found = told("audit", store.audit(&query).await)?;
        let expected: Vec<AuditEntry> = entries.iter().filter(|entry| holds(entry)).cloned().collect();
        same(&format!("{query:?}"), &found, &expected)?;
    }
    same("all pages", &pages(store.as_ref(), 3).await?, &entries)
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
///
/// # Errors
/// How the store breaks the rule.
pub async fn audit_written_twice_is_there_once(fixture: &dyn Fixture) -> Outcome {
    let store = fresh(fixture, "audit-twice").await?;
    let entries = [entry(1), entry(2), entry(3)];
    told("append_audit", store.append_audit(&entries[..2]).await)?;
    told("append_audit", store.append_audit(&entries).await)?;
    told("append_audit of nothing", store.append_audit(&[]).await)?;
    let query = AuditQuery {
        limit: 10,
        ..AuditQuery::default()
    };
    same("entries", &told("audit", store.audit(&query).await)?.len(), &3)
}

/// Entries of commits and others are one audit, newest first by their ids, also where ids do not follow revisions, and
/// whatever of it is trimmed.
///
/// # Errors
/// How the store breaks the rule.
pub async fn audit_of_commits_is_among_the_rest(fixture: &dyn Fixture) -> Outcome {
    let mut model = Model::new(fixture, "merged").await?;
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
        commit(model.store.as_ref(), &[written]).await?;
        let apart = entry(number);
        told(
            "append_audit",
            model.store.append_audit(std::slice::from_ref(&apart)).await,
        )?;
        all.push(apart);
    }
    all.sort_by(|one, other| other.id.cmp(&one.id));
    for floor in [0, 5, 12] {
        told("trim", model.store.trim(floor, 1).await)?;
        told("tidy", model.store.tidy().await)?;
        for limit in [1, 4, 100] {
            let found = pages(model.store.as_ref(), limit).await?;
            same(&format!("pages of {limit}, floor {floor}"), &found, &all)?;
        }
        let query = AuditQuery {
            subject: Some("eve".to_owned()),
            allowed: Some(true),
            limit: 100,
            ..AuditQuery::default()
        };
        let found = told("audit", model.store.audit(&query).await)?;
        let expected = all.iter().filter(|entry| entry.subject == "eve" && entry.allowed);
        same("entries of one subject", &found, &expected.cloned().collect())?;
    }
    Ok(())
}

/// All of the audit, in pages.
async fn pages(store: &dyn FullStore, limit: usize) -> Outcome<Vec<AuditEntry>> {
    let mut paged: Vec<AuditEntry> = Vec::new();
    loop {
        let query = AuditQuery {
            below: paged.last().map(|entry| entry.id.clone()),
            limit,
            ..AuditQuery::default()
        };
        let page = told("audit", store.audit(&query).await)?;
        if page.is_empty() {
            return Ok(paged);
        }
        paged.extend(page);
    }
}

/// An answer is found until its time, and not after it, even while it is still stored.
///
/// # Errors
/// How the store breaks the rule.
pub async fn answers_are_kept_until_they_expire(fixture: &dyn Fixture) -> Outcome {
    let store = fresh(fixture, "expiry").await?;
    let mut written = record(samples::commit(1, &["a"]));
    let kept = answer("one", 1);
    let expires = kept.expires;
    written.idempotency = Some(kept.clone());
    commit(store.as_ref(), &[written]).await?;
    let before = Timestamp::from_millis(expires.as_millis() - 1);
    same(
        "just before",
        &told("idempotency", store.idempotency("one", before).await)?,
        &Some(kept),
    )?;
    same(
        "at its end",
        &told("idempotency", store.idempotency("one", expires).await)?,
        &None,
    )?;
    same(
        "another id",
        &told("idempotency", store.idempotency("two", before).await)?,
        &None,
    )
}

/// Tokens are listed newest first until they expire; the first revocation stays; each has its audit entry.
///
/// # Errors
/// How the store breaks the rule.
pub async fn tokens_are_kept_and_revoked(fixture: &dyn Fixture) -> Outcome {
    let store = fresh(fixture, "tokens").await?;
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
        told("add_token", store.add_token(token, &audit("token_create", None)).await)?;
    }
    let mut expected: Vec<TokenRecord> = tokens.clone();
    expected.reverse();
    same("the tokens", &told("tokens", store.tokens(now()).await)?, &expected)?;
    let times = [start + 500, start + 900].map(Timestamp::from_millis);
    for time in times {
        let found = told(
            "revoke_token",
            store.revoke_token("two", time, &audit("token_revoke", None)).await,
        )?;
        same("that there is a token of that id", &found, &true)?;
    }
    for token in &mut expected {
        token.revoke_time = (token.id == "two").then_some(Timestamp::from_millis(start + 500));
    }
    same("the tokens", &told("tokens", store.tokens(now()).await)?, &expected)?;
    let found = told(
        "revoke_token",
        store.revoke_token("four", now(), &audit("token_revoke", None)).await,
    )?;
    same("that there is a token that was never made", &found, &false)?;
    let later = Timestamp::from_millis(start + 3_600_000 * 2);
    same(
        "tokens when all have expired",
        &told("tokens", store.tokens(later).await)?.len(),
        &0,
    )?;
    for (action, count) in [("token_create", 3), ("token_revoke", 2)] {
        let query = AuditQuery {
            action: Some(action.to_owned()),
            limit: 10,
            ..AuditQuery::default()
        };
        same(
            &format!("entries of {action}"),
            &told("audit", store.audit(&query).await)?.len(),
            &count,
        )?;
    }
    Ok(())
}
