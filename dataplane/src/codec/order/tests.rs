//! Nothing overtakes; nothing is counted wrongly.

use super::*;
use proptest::prelude::*;

const ROOMY: Bounds = Bounds {
    items: 1_000,
    bytes: 1_000_000,
    items_of_one: 1_000,
    bytes_of_one: 1_000_000,
};

fn queue(bounds: Bounds) -> InOrder<u8, char, u32> {
    InOrder::new(bounds)
}

fn pop_all(queue: &mut InOrder<u8, char, u32>, key: u8) -> Vec<u32> {
    std::iter::from_fn(|| queue.pop_ready(&key)).collect()
}

#[test]
fn what_is_ready_waits_for_what_came_before() {
    let mut queue = queue(ROOMY);
    queue.push_ready(1, 1, 10).unwrap();
    assert_eq!(pop_all(&mut queue, 1), [1]);
    assert!(queue.is_clear(&1));
    let first = queue.push_pending(1, 'a', 100).unwrap();
    let second = queue.push_pending(1, 'b', 100).unwrap();
    queue.push_ready(1, 4, 10).unwrap();
    assert!(!queue.is_clear(&1));
    // Another key does not wait.
    queue.push_ready(2, 9, 10).unwrap();
    assert_eq!(pop_all(&mut queue, 2), [9]);
    queue.finish(&second, 3, 50).unwrap();
    assert!(pop_all(&mut queue, 1).is_empty());
    assert_eq!(queue.waiting(), Waiting { items: 3, bytes: 160 });
    queue.finish(&first, 2, 50).unwrap();
    assert_eq!(pop_all(&mut queue, 1), [2, 3, 4]);
    assert_eq!(
        (queue.waiting(), queue.waiting_of(&1)),
        (Waiting::default(), Waiting::default())
    );
}

#[test]
fn what_comes_to_nothing_holds_nobody_up() {
    let mut queue = queue(ROOMY);
    let first = queue.push_pending(1, 'a', 100).unwrap();
    queue.push_ready(1, 2, 10).unwrap();
    assert!(queue.begin(&first));
    assert!(queue.give_up(&first));
    assert_eq!(pop_all(&mut queue, 1), [2]);
    assert!(!queue.give_up(&first) && !queue.begin(&first));
    assert_eq!(queue.finish(&first, 7, 1), Err(7));
}

#[test]
fn a_ticket_is_good_for_one_result() {
    let mut queue = queue(ROOMY);
    let blocker = queue.push_pending(1, 'a', 1).unwrap();
    let ticket = queue.push_pending(1, 'a', 1).unwrap();
    queue.finish(&ticket, 1, 1).unwrap();
    assert_eq!(queue.finish(&ticket, 2, 1), Err(2));
    assert!(!queue.give_up(&ticket), "what is ready stays");
    queue.finish(&blocker, 0, 1).unwrap();
    assert_eq!(pop_all(&mut queue, 1), [0, 1]);
    assert_eq!(queue.finish(&ticket, 3, 1), Err(3));
}

#[test]
fn a_writer_keeps_its_newest_and_what_is_begun() {
    let mut queue = queue(ROOMY);
    let tickets: Vec<_> = (0..5).map(|_| queue.push_pending(1, 'a', 10).unwrap()).collect();
    let other = queue.push_pending(1, 'b', 10).unwrap();
    assert!(queue.begin(&tickets[0]));
    assert_eq!(queue.keep_newest(&1, &'a', 1), Waiting { items: 3, bytes: 30 });
    assert_eq!(queue.keep_newest(&1, &'a', 1), Waiting::default());
    let alive: Vec<bool> = tickets.iter().map(|ticket| queue.begin(ticket)).collect();
    assert_eq!(alive, [true, false, false, false, true]);
    assert_eq!(queue.finish(&tickets[2], 2, 1), Err(2));
    for (at, ticket) in [(4, &tickets[4]), (5, &other), (0, &tickets[0])] {
        queue.finish(ticket, at, 1).unwrap();
    }
    assert_eq!(pop_all(&mut queue, 1), [0, 4, 5]);
    // All of a key may go.
    let last = queue.push_pending(1, 'a', 10).unwrap();
    assert_eq!(queue.keep_newest(&1, &'a', 0), Waiting { items: 1, bytes: 10 });
    assert!(queue.is_clear(&1) && !queue.begin(&last));
}

#[test]
fn full_is_said_and_one_alone_always_fits() {
    let mut queue = queue(Bounds {
        items: 4,
        bytes: 100,
        items_of_one: 3,
        bytes_of_one: 60,
    });
    let large = queue.push_pending(1, 'a', 1_000).unwrap();
    assert_eq!(queue.push_pending(1, 'a', 0), Err(Full::Key));
    assert_eq!(queue.push_ready(2, 5, 1), Err((5, Full::All)));
    assert!(queue.give_up(&large));
    for _ in 0..3 {
        queue.push_ready(1, 0, 20).unwrap();
    }
    assert_eq!(queue.push_ready(1, 7, 0), Err((7, Full::Key)), "items");
    assert_eq!(queue.push_pending(2, 'a', 50), Err(Full::All), "bytes of all");
    queue.push_ready(2, 0, 40).unwrap();
    assert_eq!(queue.push_ready(3, 8, 0), Err((8, Full::All)), "items of all");
    assert_eq!(queue.waiting(), Waiting { items: 4, bytes: 100 });
    assert_eq!(pop_all(&mut queue, 1).len(), 3);
    queue.push_ready(3, 0, 60).unwrap();
}

#[test]
fn a_removed_key_is_gone_and_comes_back_empty() {
    let mut queue = queue(ROOMY);
    let old = queue.push_pending(1, 'a', 10).unwrap();
    queue.push_ready(1, 2, 5).unwrap();
    assert_eq!(queue.remove_key(&1), Waiting { items: 2, bytes: 15 });
    assert_eq!(
        (queue.remove_key(&1), queue.waiting()),
        (Waiting::default(), Waiting::default())
    );
    queue.push_pending(1, 'a', 10).unwrap();
    assert_eq!(
        queue.finish(&old, 1, 1),
        Err(1),
        "the old ticket is not one of the new life"
    );
    assert_eq!(old.key(), &1);
}

/// The same without any cleverness: one list of everything, in the order of arrival.
#[derive(Default)]
struct Model {
    all: Vec<(u64, u8, char, usize, Step)>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Step {
    Waits,
    Begun,
    Ready(u32),
}

impl Model {
    fn held(&self, key: Option<u8>) -> Waiting {
        let of = self.all.iter().filter(|place| key.is_none_or(|key| key == place.1));
        let (items, bytes) = of.fold((0, 0), |(items, bytes), place| (items + 1, bytes + place.3));
        Waiting { items, bytes }
    }

    fn room(&self, key: u8, bytes: usize, bounds: &Bounds) -> Result<(), Full> {
        let fits = |held: Waiting, items, most| held.items < items && (held.items == 0 || held.bytes + bytes <= most);
        if !fits(self.held(Some(key)), bounds.items_of_one, bounds.bytes_of_one) {
            return Err(Full::Key);
        }
        let all = fits(self.held(None), bounds.items, bounds.bytes);
        if all { Ok(()) } else { Err(Full::All) }
    }

    fn pending(&mut self, number: u64) -> Option<usize> {
        let is = |place: &(u64, u8, char, usize, Step)| place.0 == number && !matches!(place.4, Step::Ready(_));
        self.all.iter().position(is)
    }

    fn pop(&mut self, key: u8) -> Option<u32> {
        let first = self.all.iter().position(|place| place.1 == key)?;
        let Step::Ready(item) = self.all[first].4 else {
            return None;
        };
        self.all.remove(first);
        Some(item)
    }

    fn keep_newest(&mut self, key: u8, writer: char, keep: usize) -> Waiting {
        let waits =
            |place: &(u64, u8, char, usize, Step)| place.1 == key && place.2 == writer && place.4 == Step::Waits;
        let surplus = self
            .all
            .iter()
            .filter(|place| waits(place))
            .count()
            .saturating_sub(keep);
        let (mut left, mut bytes) = (surplus, 0);
        self.all.retain(|place| {
            let goes = left > 0 && waits(place);
            (left, bytes) = if goes {
                (left - 1, bytes + place.3)
            } else {
                (left, bytes)
            };
            !goes
        });
        Waiting { items: surplus, bytes }
    }
}

#[derive(Debug, Clone)]
enum Act {
    Ready(u8, usize),
    Pending(u8, char, usize),
    Begin(usize),
    Finish(usize, usize),
    GiveUp(usize),
    Pop(u8),
    KeepNewest(u8, char, usize),
    RemoveKey(u8),
}

fn act() -> impl Strategy<Value = Act> {
    let (key, writer, bytes) = (0u8..3, prop_oneof![Just('a'), Just('b')], 0usize..40);
    let pending =
        (key.clone(), writer.clone(), bytes.clone()).prop_map(|(key, writer, bytes)| Act::Pending(key, writer, bytes));
    prop_oneof![
        3 => (key.clone(), bytes.clone()).prop_map(|(key, bytes)| Act::Ready(key, bytes)),
        6 => pending,
        3 => (0usize..100).prop_map(Act::Begin),
        5 => (0usize..100, bytes).prop_map(|(at, bytes)| Act::Finish(at, bytes)),
        2 => (0usize..100).prop_map(Act::GiveUp),
        4 => key.clone().prop_map(Act::Pop),
        1 => (key.clone(), writer, 0usize..4).prop_map(|(key, writer, keep)| Act::KeepNewest(key, writer, keep)),
        1 => key.prop_map(Act::RemoveKey),
    ]
}

proptest! {
    #[test]
    fn it_does_what_a_list_does(acts in proptest::collection::vec(act(), 1..120), tight: bool) {
        let bounds = if tight {
            Bounds { items: 8, bytes: 150, items_of_one: 5, bytes_of_one: 80 }
        } else {
            ROOMY
        };
        let (mut queue, mut model) = (queue(bounds), Model::default());
        let mut tickets = Vec::new();
        for (item, act) in (0u32..).zip(acts) {
            // Older tickets than these are tried too: they must do nothing.
            let chosen = |at: usize, tickets: &[Ticket<u8>]| (!tickets.is_empty()).then(|| tickets[at % tickets.len()]);
            match act {
                Act::Ready(key, bytes) => {
                    let room = model.room(key, bytes, &bounds);
                    let number = queue.next;
                    prop_assert_eq!(queue.push_ready(key, item, bytes), room.map_err(|full| (item, full)));
                    if room.is_ok() {
                        model.all.push((number, key, '-', bytes, Step::Ready(item)));
                    }
                }
                Act::Pending(key, writer, bytes) => {
                    let room = model.room(key, bytes, &bounds);
                    let pushed = queue.push_pending(key, writer, bytes);
                    prop_assert_eq!(pushed.map(|_| ()), room);
                    if let Ok(ticket) = pushed {
                        model.all.push((ticket.number, key, writer, bytes, Step::Waits));
                        tickets.push(ticket);
                    }
                }
                Act::Begin(at) => if let Some(ticket) = chosen(at, &tickets) {
                    let there = model.all.iter().any(|place| place.0 == ticket.number);
                    prop_assert_eq!(queue.begin(&ticket), there);
                    if let Some(at) = model.pending(ticket.number) {
                        model.all[at].4 = Step::Begun;
                    }
                },
                Act::Finish(at, bytes) => if let Some(ticket) = chosen(at, &tickets) {
                    let at = model.pending(ticket.number);
                    prop_assert_eq!(queue.finish(&ticket, item, bytes), at.map(|_| ()).ok_or(item));
                    if let Some(at) = at {
                        (model.all[at].3, model.all[at].4) = (bytes, Step::Ready(item));
                    }
                },
                Act::GiveUp(at) => if let Some(ticket) = chosen(at, &tickets) {
                    let at = model.pending(ticket.number);
                    prop_assert_eq!(queue.give_up(&ticket), at.is_some());
                    at.map(|at| model.all.remove(at));
                },
                Act::Pop(key) => prop_assert_eq!(queue.pop_ready(&key), model.pop(key)),
                Act::KeepNewest(key, writer, keep) => {
                    prop_assert_eq!(queue.keep_newest(&key, &writer, keep), model.keep_newest(key, writer, keep));
                }
                Act::RemoveKey(key) => {
                    prop_assert_eq!(queue.remove_key(&key), model.held(Some(key)));
                    model.all.retain(|place| place.1 != key);
                }
            }
            prop_assert_eq!(queue.waiting(), model.held(None));
            for key in 0..3 {
                prop_assert_eq!(queue.waiting_of(&key), model.held(Some(key)));
                prop_assert_eq!(queue.is_clear(&key), model.held(Some(key)).items == 0);
                let queue = queue.queues.get(&key);
                let waits: usize = queue.map_or(0, |queue| queue.waits.values().map(VecDeque::len).sum());
                let expected = model.all.iter().filter(|place| place.1 == key && place.4 == Step::Waits).count();
                prop_assert_eq!(waits, expected, "nothing is left behind");
            }
        }
    }
}
