//! Nothing overtakes within a line; nothing is counted wrongly; nobody is forgotten.

use super::*;
use proptest::prelude::*;

const ROOMY: Bounds = Bounds {
    items: 1_000,
    bytes: 1_000_000,
    items_of_one: 1_000,
    bytes_of_one: 1_000_000,
    waiting_of_one: 1_000_000,
};
const LONG: Urgency = Urgency::Long;

type Key = (u8, char);
type Queue = InOrder<u8, char, u32>;

fn pop_all(queue: &mut Queue, key: Key) -> Vec<u32> {
    std::iter::from_fn(|| queue.pop_ready(&key)).collect()
}

/// Keeps a place for which there is room.
fn wait(queue: &mut Queue, key: Key, item: u32, bytes: usize, keep: usize) -> Vec<u32> {
    let pushed = queue.push_waiting(key, LONG, item, bytes, keep);
    assert!(pushed.refused.is_none());
    pushed.gave_way
}

/// Who is begun with next.
fn begin(queue: &mut Queue) -> Option<(Ticket<u8, char>, u32)> {
    queue.begin(LONG).map(|(ticket, item)| (ticket, *item))
}

#[test]
fn what_is_ready_waits_for_what_came_before_in_its_line() {
    let mut queue = Queue::new(ROOMY);
    let key = (1, 'a');
    queue.push_ready(key, 1, 10).unwrap();
    assert_eq!(pop_all(&mut queue, key), [1]);
    assert!(queue.is_clear(&key) && !queue.holds(&1));
    wait(&mut queue, key, 2, 100, 0);
    wait(&mut queue, key, 3, 100, 0);
    queue.push_ready(key, 4, 10).unwrap();
    // Another writer of the topic does not wait, nor does another topic.
    assert!(queue.is_clear(&(1, 'b')) && queue.holds(&1));
    queue.push_ready((1, 'b'), 8, 10).unwrap();
    queue.push_ready((2, 'a'), 9, 10).unwrap();
    assert_eq!((pop_all(&mut queue, (1, 'b')), pop_all(&mut queue, (2, 'a'))), (vec![8], vec![9]));
    let (first, item) = begin(&mut queue).unwrap();
    assert_eq!((item, *first.key()), (2, key));
    let (second, _) = begin(&mut queue).unwrap();
    *queue.begun(&second).unwrap() = 33;
    assert!(queue.finish(&second, 50));
    assert!(pop_all(&mut queue, key).is_empty());
    assert_eq!(queue.held(), Waiting { items: 3, bytes: 160 });
    assert!(queue.finish(&first, 50));
    assert_eq!(pop_all(&mut queue, key), [2, 33, 4]);
    assert_eq!((queue.held(), queue.waits(LONG)), (Waiting::default(), Waiting::default()));
}

/// A frame that replaces a waiting one has waited as long as that: else who publishes often would
/// never be begun with.
#[test]
fn who_gives_way_leaves_its_turn_to_the_newer_one() {
    let mut queue = Queue::new(ROOMY);
    wait(&mut queue, (1, 'a'), 1, 10, 1);
    wait(&mut queue, (2, 'a'), 20, 10, 1);
    for item in 2..10 {
        assert_eq!(wait(&mut queue, (1, 'a'), item, 10, 1), [item - 1]);
    }
    assert_eq!(queue.waits(LONG), Waiting { items: 2, bytes: 20 });
    let order: Vec<u32> = std::iter::from_fn(|| begin(&mut queue)).map(|(_, item)| item).collect();
    assert_eq!(order, [9, 20]);
}

#[test]
fn turns_go_round_groups_and_within_them_round_lines() {
    let mut queue = Queue::new(ROOMY);
    for item in 0..4 {
        wait(&mut queue, (1, 'a'), item, 10, 0);
    }
    for item in 10..12 {
        wait(&mut queue, (1, 'b'), item, 10, 0);
    }
    wait(&mut queue, (2, 'a'), 20, 10, 0);
    wait(&mut queue, (2, 'a'), 21, 10, 0);
    wait(&mut queue, (3, 'a'), 30, 10, 0);
    queue.push_waiting((4, 'a'), Urgency::Quick, 40, 10, 0);
    let order: Vec<u32> = std::iter::from_fn(|| begin(&mut queue)).map(|(_, item)| item).collect();
    assert_eq!(order, [0, 20, 30, 10, 21, 1, 11, 2, 3]);
    assert_eq!(queue.begin(Urgency::Quick).map(|(_, item)| *item), Some(40));
}

#[test]
fn everything_of_a_group_can_be_looked_at() {
    let mut queue = Queue::new(ROOMY);
    wait(&mut queue, (1, 'a'), 1, 10, 0);
    wait(&mut queue, (1, 'b'), 2, 10, 0);
    begin(&mut queue).unwrap();
    queue.push_ready((1, 'a'), 3, 10).unwrap();
    wait(&mut queue, (2, 'a'), 4, 10, 0);
    let mut items: Vec<u32> = queue.items_mut(&1).map(|item| *item).collect();
    items.sort_unstable();
    assert_eq!(items, [1, 2, 3]);
    assert_eq!(queue.items_mut(&9).count(), 0);
}

/// The same without any cleverness: one list of everything, in the order of arrival.
#[derive(Default)]
struct Model {
    all: Vec<Entry>,
}

#[derive(Debug, Clone, Copy)]
struct Entry {
    number: u64,
    key: Key,
    urgency: Urgency,
    bytes: usize,
    stage: Stage,
    item: u32,
}

impl Model {
    fn sum(&self, wanted: impl Fn(&Entry) -> bool) -> Waiting {
        let of = self.all.iter().filter(|entry| wanted(entry));
        let (items, bytes) =
            of.fold((0, 0), |(items, bytes), entry| (items + 1, bytes + entry.bytes));
        Waiting { items, bytes }
    }

    fn room(
        &self,
        key: Key,
        bytes: usize,
        waits: bool,
        freed: Waiting,
        bounds: &Bounds,
    ) -> Result<(), Full> {
        let fits = |held: Waiting, items, most| {
            let held = held.without(freed);
            held.items < items && (held.items == 0 || held.bytes + bytes <= most)
        };
        let of_one = self.sum(|entry| entry.key.0 == key.0);
        let waiting = self.sum(|entry| entry.key.0 == key.0 && entry.stage == Stage::Waits);
        if !fits(of_one, bounds.items_of_one, bounds.bytes_of_one)
            || (waits && !fits(waiting, bounds.items_of_one, bounds.waiting_of_one))
        {
            return Err(Full::Group);
        }
        let all = fits(self.sum(|_| true), bounds.items, bounds.bytes);
        if all { Ok(()) } else { Err(Full::All) }
    }

    /// What would have to give way.
    fn surplus(
        &self,
        key: Key,
        urgency: Urgency,
        bytes: usize,
        keep: usize,
        bounds: &Bounds,
    ) -> Vec<Entry> {
        let waits = |entry: &&Entry| {
            entry.key == key && entry.urgency == urgency && entry.stage == Stage::Waits
        };
        let waiting: Vec<Entry> = self.all.iter().filter(waits).copied().collect();
        if keep == 0 {
            return Vec::new();
        }
        let of_group = self.sum(|entry| entry.key.0 == key.0 && entry.stage == Stage::Waits);
        let fits = |gone: &[Entry]| {
            let gone: usize = gone.iter().map(|entry| entry.bytes).sum::<usize>();
            of_group.bytes - gone + bytes <= bounds.waiting_of_one
        };
        let is_enough = |count: &usize| {
            let left = of_group.items - count;
            let has_room = left == 0 || (left < bounds.items_of_one && fits(&waiting[..*count]));
            waiting.len() - count < keep && has_room
        };
        let surplus = (0..=waiting.len()).find(is_enough).unwrap_or(waiting.len());
        waiting[..surplus].to_vec()
    }

    fn at(&self, number: u64, stage: Stage) -> Option<usize> {
        let is = |entry: &Entry| entry.number == number && entry.stage == stage;
        self.all.iter().position(is)
    }

    fn pop(&mut self, key: Key) -> Option<u32> {
        let first = self.all.iter().position(|entry| entry.key == key)?;
        let ready = self.all[first].stage == Stage::Ready;
        ready.then(|| self.all.remove(first).item)
    }
}

#[derive(Debug, Clone)]
enum Act {
    Ready(Key, usize),
    Wait(Key, Urgency, usize, usize),
    Begin(Urgency),
    Again(usize, Urgency),
    Finish(usize, usize),
    GiveUp(usize),
    Pop(Key),
}

fn act() -> impl Strategy<Value = Act> {
    let key = || (0u8..3, prop_oneof![Just('a'), Just('b')]);
    let urgency = || prop_oneof![Just(Urgency::Quick), Just(Urgency::Long)];
    prop_oneof![
        3 => (key(), 0usize..40).prop_map(|(key, bytes)| Act::Ready(key, bytes)),
        7 => (key(), urgency(), 0usize..40, 0usize..4)
            .prop_map(|(key, urgency, bytes, keep)| Act::Wait(key, urgency, bytes, keep)),
        4 => urgency().prop_map(Act::Begin),
        2 => (0usize..100, urgency()).prop_map(|(at, urgency)| Act::Again(at, urgency)),
        5 => (0usize..100, 0usize..40).prop_map(|(at, bytes)| Act::Finish(at, bytes)),
        2 => (0usize..100).prop_map(Act::GiveUp),
        4 => key().prop_map(Act::Pop),
    ]
}

proptest! {
    #[test]
    fn it_does_what_a_list_does(acts in proptest::collection::vec(act(), 1..120), tight: bool) {
        let bounds = if tight {
            Bounds { items: 8, bytes: 150, items_of_one: 5, bytes_of_one: 80, waiting_of_one: 60 }
        } else {
            ROOMY
        };
        let (mut queue, mut model) = (Queue::new(bounds), Model::default());
        let mut tickets: Vec<Ticket<u8, char>> = Vec::new();
        for (item, act) in (0u32..).zip(acts) {
            // Older tickets than these are tried too: they must do nothing.
            let chosen = |at: usize,
            tickets: &[Ticket<u8, char>]| (!tickets.is_empty())
            .then(|| tickets[at % tickets.len()]);
            let number = queue.next;
            match act {
                Act::Ready(key, bytes) => {
                    let room = model.room(key, bytes, false, Waiting::default(), &bounds);
                    prop_assert_eq!(
                        queue.push_ready(key, item, bytes),
                        room.map_err(|full| (item, full)),
                    );
                    if room.is_ok() {
                        let urgency = Urgency::Quick;
                        model.all.push(Entry { number, key, urgency, bytes, stage: Stage::Ready,
                            item });
                    }
                }
                Act::Wait(key, urgency, bytes, keep) => {
                    let surplus = model.surplus(key, urgency, bytes, keep, &bounds);
                    let mut freed = Waiting::default();
                    surplus.iter().for_each(|entry| freed.add(entry.bytes));
                    let room = model.room(key, bytes, true, freed, &bounds);
                    let pushed = queue.push_waiting(key, urgency, item, bytes, keep);
                    prop_assert_eq!(pushed.refused, room.err().map(|full| (item, full)));
                    let expected: Vec<u32> = surplus.iter().map(|entry| entry.item).collect();
                    prop_assert_eq!(
                        pushed.gave_way,
                        if room.is_ok() { expected } else { Vec::new() },
                    );
                    if room.is_ok() {
                        model.all.retain(|entry| surplus.iter()
                            .all(|gone| gone.number != entry.number));
                        model.all.push(Entry { number, key, urgency, bytes, stage: Stage::Waits,
                            item });
                    }
                }
                Act::Begin(urgency) => {
                    let begun = queue.begin(urgency).map(|(ticket, item)| (ticket, *item));
                    let waits =
                        model.sum(|entry| entry.urgency == urgency && entry.stage == Stage::Waits);
                    prop_assert_eq!(begun.is_some(), waits.items > 0, "whoever waits has a turn");
                    if let Some((ticket, item)) = begun {
                        let at = model.at(ticket.number, Stage::Waits).unwrap();
                        prop_assert_eq!(
                            (model.all[at].item, model.all[at].urgency),
                            (item, urgency),
                        );
                        let key = model.all[at].key;
                        let older = model.all[..at].iter();
                        let mut older =
                            older.filter(|entry| entry.key == key && entry.urgency == urgency);
                        prop_assert!(
                            older.all(|entry| entry.stage != Stage::Waits),
                            "the oldest of its line first",
                        );
                        model.all[at].stage = Stage::Begun;
                        tickets.push(ticket);
                    }
                }
                Act::Again(at, urgency) => if let Some(ticket) = chosen(at, &tickets) {
                    let at = model.at(ticket.number, Stage::Begun);
                    prop_assert_eq!(queue.wait_again(&ticket, urgency), at.is_some());
                    if let Some(at) = at {
                        (model.all[at].urgency, model.all[at].stage) = (urgency, Stage::Waits);
                    }
                },
                Act::Finish(at, bytes) => if let Some(ticket) = chosen(at, &tickets) {
                    let at = model.at(ticket.number, Stage::Begun);
                    prop_assert_eq!(queue.finish(&ticket, bytes), at.is_some());
                    if let Some(at) = at {
                        (model.all[at].bytes, model.all[at].stage) = (bytes, Stage::Ready);
                    }
                },
                Act::GiveUp(at) => if let Some(ticket) = chosen(at, &tickets) {
                    let at = model.at(ticket.number, Stage::Begun);
                    let expected = at.map(|at| model.all.remove(at).item);
                    prop_assert_eq!(queue.give_up(&ticket), expected);
                },
                Act::Pop(key) => prop_assert_eq!(queue.pop_ready(&key), model.pop(key)),
            }
            prop_assert_eq!(queue.held(), model.sum(|_| true));
            for urgency in Urgency::ALL {
                let waits = |entry: &Entry| entry.urgency == urgency && entry.stage == Stage::Waits;
                prop_assert_eq!(queue.waits(urgency), model.sum(waits));
            }
            for group in 0..3 {
                prop_assert_eq!(
                    queue.holds(&group),
                    model.sum(|entry| entry.key.0 == group).items > 0,
                );
                for line in ['a', 'b'] {
                    let key = (group, line);
                    prop_assert_eq!(
                        queue.is_clear(&key),
                        model.sum(|entry| entry.key == key).items == 0,
                    );
                }
            }
        }
    }
}
