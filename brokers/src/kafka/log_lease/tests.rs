//! The rules of the log, with several owners who read and write at times of their own.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use proptest::prelude::*;

use super::ledger::{Act, Entry, Ledger, Place, Step};

const TIME_MS: u64 = 1000;
const TIME: Duration = Duration::from_millis(TIME_MS);
/// What is older may have been compacted. Nobody is stopped for so long and goes on: the topic has an hour for that.
const COMPACTED_MS: u64 = 10 * TIME_MS;

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
fn what_was_compacted_is_believed_until_somebody_goes_on_with_a_term() {
    let begin = Instant::now();
    // A claim that lost is the last record of what was compacted; the one that won goes on.
    let mut ledger = Ledger::default();
    ledger.apply(claim("b", 2, 5, true), place(7, 0, begin));
    ledger.apply(entry("a", 1, Act::Renew), place(8, 1, begin));
    ledger.is_caught_up();
    assert_eq!((ledger.own_term("a"), ledger.own_term("b")), (Some((1, 8)), None));
    // Nobody goes on: it is taken over like any other.
    let mut ledger = Ledger::default();
    ledger.apply(claim("b", 2, 5, true), place(7, 0, begin));
    ledger.is_caught_up();
    ledger.apply(claim("c", 3, 7, false), place(8, TIME_MS + 1, begin));
    assert_eq!(ledger.own_term("c"), Some((3, 8)));
    ledger.apply(entry("b", 2, Act::Renew), place(9, TIME_MS + 2, begin));
    assert_eq!(ledger.own_term("c"), Some((3, 8)), "an old term is renewed in vain");
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
    /// Another process begins in place of an owner, and finds of what is old the last record alone.
    Restart(usize),
}

fn event() -> impl Strategy<Value = Event> {
    let owner = 0..3_usize;
    prop_oneof![
        6 => (1..1500_u64).prop_map(Event::Pass),
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
    on_the_way: VecDeque<Entry>,
    /// When it asked what it has not settled yet, which term, and where its record came to lie.
    asked: Option<(u64, u64, Option<i64>)>,
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
    log: Vec<(Entry, u64)>,
    owners: Vec<Owner>,
    born: usize,
}

impl World {
    fn read(&mut self, owner: usize, records: usize) {
        let owner = &mut self.owners[owner];
        let end = self.log.len().min(owner.position.saturating_add(records));
        for offset in owner.position..end {
            let (entry, appended) = &self.log[offset];
            let place = Place {
                read: self.begin + Duration::from_millis(self.now),
                ..place(i64::try_from(offset).unwrap(), *appended, self.begin)
            };
            owner.ledger.apply(entry.clone(), place);
        }
        owner.position = end;
    }

    /// Of what is old there is the last record alone.
    fn restart(&mut self, number: usize) {
        self.born += 1;
        self.owners[number] = Owner::new(format!("p{}", self.born));
        let old = self.now.saturating_sub(COMPACTED_MS);
        let compacted = self.log.iter().take_while(|(_, appended)| *appended < old).count();
        self.owners[number].position = compacted.saturating_sub(1);
        self.read(number, usize::MAX);
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
            owner.asked = Some((self.now, entry.term, None));
        }
        owner.on_the_way.push_back(entry);
    }

    fn arrive(&mut self, number: usize) {
        let owner = &mut self.owners[number];
        let Some(entry) = owner.on_the_way.pop_front() else {
            return;
        };
        if let Some((_, _, lies)) = &mut owner.asked
            && owner.on_the_way.is_empty()
        {
            *lies = i64::try_from(self.log.len()).ok();
        }
        self.log.push((entry, self.now));
    }

    fn settle(&mut self, number: usize) {
        let Some((asked, term, Some(offset))) = self.owners[number].asked else {
            return;
        };
        self.read(number, usize::MAX);
        let owner = &mut self.owners[number];
        owner.asked = None;
        if owner.ledger.own_term(&owner.name) == Some((term, offset)) {
            owner.until = asked + TIME_MS;
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
    fn after_whatever_happened_somebody_has_it_again(events in proptest::collection::vec(event(), 1..200)) {
        let mut world = world();
        for event in &events {
            world.run(event);
        }
        for owner in 0..3 {
            while !world.owners[owner].on_the_way.is_empty() {
                world.arrive(owner);
            }
            world.settle(owner);
        }
        world.now += 1;
        for owner in 0..3 {
            world.read(owner, usize::MAX);
        }
        world.now += TIME_MS;
        for owner in 0..3 {
            world.read(owner, usize::MAX);
            world.ask(owner, false);
            world.arrive(owner);
            world.settle(owner);
        }
        let holders = world.holders();
        prop_assert_eq!(holders.len(), 1);
    }
}
