//! The rules of the log, with several owners who read and write at times of their own.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use proptest::prelude::*;

use super::ledger::{Act, Entry, Ledger, Place, Step};

const TIME_MS: u64 = 1000;
const TIME: Duration = Duration::from_millis(TIME_MS);
/// What is older may have been compacted. Far less than the hour that the topic has for that: here owners are stopped for as
/// long, so that they know other remains than who begins.
const COMPACTED_MS: u64 = 5 * TIME_MS;
/// What has not arrived after this never does.
const GIVEN_UP_MS: u64 = 3 * TIME_MS;

fn entry(owner: &str, term: u64, act: Act) -> Entry {
    Entry {
        owner: owner.to_owned(),
        term,
        act,
        time_ms: TIME_MS,
        note: None,
    }
}

fn claim(owner: &str, term: u64, after: impl Into<Option<i64>>, has_waited: bool) -> Entry {
    let after = after.into();
    entry(owner, term, Act::Claim { after, has_waited })
}

fn place(offset: i64, at_ms: u64, begin: Instant) -> Place {
    Place {
        offset,
        appended_ms: i64::try_from(at_ms).ok(),
        read: begin + Duration::from_millis(at_ms),
        is_after_gap: false,
    }
}

#[test]
fn what_is_written_is_read_and_anything_else_is_no_record() {
    let one = Entry {
        note: Some("\"a\"".to_owned()),
        ..claim("a", 7, 12, false)
    };
    assert_eq!(Entry::parse(&one.to_bytes().unwrap()), Some(one));
    for bytes in [&b""[..], b"{}", b"7", b"{\"term\":1}", &[b' '; 5000]] {
        assert_eq!(Entry::parse(bytes), None);
    }
    let large = Entry {
        note: Some("x".repeat(5000)),
        ..entry("a", 1, Act::Renew)
    };
    assert!(large.to_bytes().unwrap_err().contains("too large"));
}

#[test]
fn the_first_of_two_claims_counts_and_neither_takes_what_was_renewed() {
    let begin = Instant::now();
    let mut ledger = Ledger::default();
    ledger.apply(claim("a", 1, None, true), place(0, 0, begin));
    ledger.apply(claim("b", 1, None, true), place(1, 1, begin));
    assert_eq!(ledger.own_term("a"), Some((1, 0)));
    ledger.apply(entry("a", 1, Act::Renew), place(2, 900, begin));
    // Its writer had waited, but had not read the renewal.
    ledger.apply(claim("b", 2, 0, true), place(3, 1001, begin));
    assert_eq!(ledger.own_term("b"), None);
    // By the server's clock it is too early, and then it is not.
    ledger.apply(claim("b", 2, 2, false), place(4, 1900, begin));
    assert_eq!(ledger.own_term("b"), None);
    ledger.apply(claim("b", 2, 2, false), place(5, 1901, begin));
    assert_eq!((ledger.own_term("a"), ledger.own_term("b")), (None, Some((2, 5))));
    ledger.apply(entry("a", 1, Act::Renew), place(6, 1902, begin));
    assert_eq!(ledger.own_term("b"), Some((2, 5)), "an old term is renewed in vain");
}

#[test]
fn what_is_given_up_is_had_at_once_with_what_lies_beside_it() {
    let begin = Instant::now();
    let mut ledger = Ledger::default();
    ledger.apply(claim("a", 1, None, true), place(0, 0, begin));
    let noted = Entry {
        note: Some("7".to_owned()),
        ..entry("a", 1, Act::Release)
    };
    ledger.apply(noted, place(1, 1, begin));
    assert_eq!((ledger.note(), ledger.ends()), (Some("7"), None));
    let act = Act::Claim {
        after: Some(1),
        has_waited: true,
    };
    for owner in ["a", "b"] {
        assert_eq!(ledger.step(owner, begin), Step::Claim { term: 2, act });
    }
}

#[test]
fn who_begins_to_read_asks_the_clock_of_the_server_once_and_then_waits() {
    let begin = Instant::now();
    let mut ledger = Ledger::default();
    ledger.apply(entry("a", 3, Act::Renew), place(7, 0, begin));
    ledger.is_caught_up();
    let act = |has_waited| Act::Claim {
        after: Some(7),
        has_waited,
    };
    assert_eq!(
        ledger.step("b", begin),
        Step::Claim {
            term: 4,
            act: act(false)
        }
    );
    ledger.apply(entry("b", 4, act(false)), place(8, 999, begin));
    assert_eq!(ledger.step("b", begin), Step::Wait);
    assert_eq!(
        ledger.step("b", begin + TIME),
        Step::Claim {
            term: 4,
            act: act(true)
        }
    );
}

#[test]
fn of_what_was_compacted_the_last_that_goes_on_with_a_term_counts() {
    let begin = Instant::now();
    // Two claims that lost are still there, what they lost against is not.
    let mut ledger = Ledger::default();
    let after_gap = |offset, at_ms| Place {
        is_after_gap: true,
        ..place(offset, at_ms, begin)
    };
    ledger.apply(claim("b", 1, None, true), after_gap(1, 0));
    ledger.apply(claim("c", 2, 5, true), after_gap(7, 1));
    ledger.apply(entry("a", 1, Act::Renew), after_gap(9, 2));
    ledger.is_caught_up();
    assert_eq!(ledger.own_term("a"), Some((1, 9)));
    // Who reads on takes nothing back.
    ledger.apply(claim("c", 2, 9, false), place(10, TIME_MS + 3, begin));
    ledger.apply(entry("a", 1, Act::Renew), place(11, TIME_MS + 4, begin));
    assert_eq!(ledger.own_term("c"), Some((2, 10)), "an old term is renewed in vain");
}

/// What happens next.
#[derive(Debug, Clone)]
enum Event {
    Pass(u64),
    /// An owner reads so many records.
    Read(usize, usize),
    /// An owner asks: it reads nothing first, and what it writes is on its way.
    Ask(usize),
    /// The oldest record of an owner that is on its way arrives.
    Arrive(usize),
    /// An owner reads all, and learns what became of what it asked.
    Settle(usize),
    Release(usize),
    /// Another process begins in place of an owner.
    Restart(usize),
}

fn event() -> impl Strategy<Value = Event> {
    let owner = 0..3_usize;
    prop_oneof![
        6 => (1..1500_u64).prop_map(Event::Pass),
        1 => (5 * TIME_MS..15 * TIME_MS).prop_map(Event::Pass),
        3 => (owner.clone(), 1..4_usize).prop_map(|(owner, records)| Event::Read(owner, records)),
        8 => owner.clone().prop_map(Event::Ask),
        8 => owner.clone().prop_map(Event::Arrive),
        8 => owner.clone().prop_map(Event::Settle),
        1 => owner.clone().prop_map(Event::Release),
        1 => owner.prop_map(Event::Restart),
    ]
}

struct Owner {
    name: String,
    ledger: Ledger,
    position: usize,
    /// With the time when it was sent.
    on_the_way: VecDeque<(u64, Entry)>,
    /// When it asked what it has not settled yet, and the last record of that, with the place where it came to lie.
    asked: Option<(u64, Entry, Option<i64>)>,
    /// Until when it may act.
    until: u64,
}

impl Owner {
    fn new(name: String) -> Self {
        Self {
            name,
            ledger: Ledger::default(),
            position: 0,
            on_the_way: VecDeque::new(),
            asked: None,
            until: 0,
        }
    }
}

struct World {
    begin: Instant,
    now: u64,
    /// Whether, and after what time, records are compacted.
    compacts_after_ms: Option<u64>,
    log: Vec<(Entry, u64)>,
    owners: Vec<Owner>,
    born: usize,
}

impl World {
    fn read(&mut self, owner: usize, records: usize) {
        self.read_as(owner, records, false);
    }

    fn read_as(&mut self, owner: usize, records: usize, is_after_gap: bool) {
        let owner = &mut self.owners[owner];
        let end = self.log.len().min(owner.position.saturating_add(records));
        for offset in owner.position..end {
            let (entry, appended) = &self.log[offset];
            let place = Place {
                read: self.begin + Duration::from_millis(self.now),
                is_after_gap,
                ..place(i64::try_from(offset).unwrap(), *appended, self.begin)
            };
            owner.ledger.apply(entry.clone(), place);
        }
        owner.position = end;
    }

    /// Another process, which finds of what is old the last record of each key alone.
    fn restart(&mut self, number: usize) {
        let old = self
            .compacts_after_ms
            .map_or(0, |after_ms| self.now.saturating_sub(after_ms));
        let compacted = self.log.iter().take_while(|(_, appended)| *appended < old).count();
        self.begin(number, compacted);
    }

    /// A process that reads what was compacted so far, and all that follows.
    fn begin(&mut self, number: usize, compacted: usize) {
        self.born += 1;
        self.owners[number] = Owner::new(format!("p{}", self.born));
        let mut has_gaps = false;
        let mut next = 0;
        for offset in 0..compacted {
            let key = |entry: &Entry| matches!(entry.act, Act::Claim { .. }).then(|| entry.owner.clone());
            let own = key(&self.log[offset].0);
            if self.log[offset + 1..compacted]
                .iter()
                .all(|(later, _)| key(later) != own)
            {
                self.owners[number].position = offset;
                has_gaps |= offset != next;
                next = offset + 1;
                self.read_as(number, 1, has_gaps);
            }
        }
        has_gaps |= next != compacted;
        self.owners[number].position = compacted;
        self.read_as(number, usize::MAX, has_gaps);
        self.owners[number].ledger.is_caught_up();
    }

    fn ask(&mut self, number: usize, is_release: bool) {
        let now = self.begin + Duration::from_millis(self.now);
        let owner = &mut self.owners[number];
        let entry = match owner.ledger.step(&owner.name, now) {
            Step::Renew(term) if is_release => entry(&owner.name, term, Act::Release),
            Step::Renew(term) => entry(&owner.name, term, Act::Renew),
            Step::Claim { term, act } if !is_release => entry(&owner.name, term, act),
            Step::Claim { .. } | Step::Wait => return,
        };
        if is_release {
            // Whoever gives it up does not act from then on.
            (owner.until, owner.asked) = (0, None);
        } else {
            owner.asked = Some((self.now, entry.clone(), None));
        }
        owner.on_the_way.push_back((self.now, entry));
    }

    fn arrive(&mut self, number: usize) {
        let owner = &mut self.owners[number];
        let Some((sent, entry)) = owner.on_the_way.pop_front() else {
            return;
        };
        if sent + GIVEN_UP_MS < self.now {
            return;
        }
        if let Some((_, _, lies)) = &mut owner.asked
            && owner.on_the_way.is_empty()
        {
            *lies = i64::try_from(self.log.len()).ok();
        }
        self.log.push((entry, self.now));
    }

    fn settle(&mut self, number: usize) {
        let Some((asked, written, Some(offset))) = self.owners[number].asked.clone() else {
            return;
        };
        self.read(number, usize::MAX);
        let owner = &mut self.owners[number];
        owner.asked = None;
        if owner.ledger.own_term(&owner.name) != Some((written.term, offset)) {
            return;
        }
        if written.act == Act::Renew {
            owner.until = asked + TIME_MS;
        } else {
            let renewal = entry(&owner.name, written.term, Act::Renew);
            owner.asked = Some((asked, renewal.clone(), None));
            owner.on_the_way.push_back((self.now, renewal));
        }
    }

    fn run(&mut self, event: &Event) {
        match *event {
            Event::Pass(ms) => self.now += ms,
            Event::Read(owner, records) => self.read(owner, records),
            Event::Ask(owner) => self.ask(owner, false),
            Event::Arrive(owner) => self.arrive(owner),
            Event::Settle(owner) => self.settle(owner),
            Event::Release(owner) => self.ask(owner, true),
            Event::Restart(owner) => self.restart(owner),
        }
    }

    fn holders(&self) -> Vec<&str> {
        let holds = |owner: &&Owner| owner.until > self.now;
        self.owners.iter().filter(holds).map(|owner| &*owner.name).collect()
    }
}

fn world() -> World {
    World {
        begin: Instant::now(),
        now: 0,
        compacts_after_ms: None,
        log: Vec::new(),
        owners: (0..3).map(|number| Owner::new(format!("o{number}"))).collect(),
        born: 0,
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]
    #[test]
    fn two_never_have_it(events in proptest::collection::vec(event(), 1..200)) {
        let mut world = world();
        for event in &events {
            world.run(event);
            let holders = world.holders();
            prop_assert!(holders.len() <= 1, "{holders:?} have it after {event:?}");
        }
    }

    #[test]
    fn after_whatever_happened_also_with_compaction_one_has_it(events in proptest::collection::vec(event(), 1..200)) {
        let mut world = World { compacts_after_ms: Some(COMPACTED_MS), ..world() };
        for event in &events {
            world.run(event);
        }
        world.now += TIME_MS;
        // Each asks as often as it should.
        for _ in 0..12 {
            world.now += TIME_MS / 3;
            for owner in 0..3 {
                world.read(owner, usize::MAX);
                world.ask(owner, false);
                while !world.owners[owner].on_the_way.is_empty() {
                    world.arrive(owner);
                    world.settle(owner);
                }
            }
        }
        for owner in 0..3 {
            world.read(owner, usize::MAX);
        }
        let holders = world.holders();
        prop_assert_eq!(holders.len(), 1, "{:?}", holders);
    }
}
