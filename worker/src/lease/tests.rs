//! Keeping a lease that lies in memory, on a server that may be away.

use parking_lot::Mutex;
use tokio::task::JoinSet;

use super::*;

const TIME: Duration = Duration::from_secs(5);

/// A server that may be away.
#[derive(Default)]
struct Server {
    held: Mutex<Option<(String, Instant)>>,
    told: Mutex<Option<Mark>>,
    is_away: Mutex<bool>,
}

struct OnServer {
    server: Arc<Server>,
    owner: String,
}

#[async_trait]
impl Lease for OnServer {
    async fn hold(&self, time: Duration, told: Option<&Mark>) -> Result<Held, String> {
        if *self.server.is_away.lock() {
            return Err("away".to_owned());
        }
        let mut held = self.server.held.lock();
        let now = Instant::now();
        let current = held.as_ref().filter(|(_, until)| *until > now);
        let was_own = current.is_some_and(|(owner, _)| *owner == self.owner);
        let is_held = was_own || current.is_none();
        if is_held {
            *held = Some((self.owner.clone(), now + time));
        }
        if was_own && let Some(told) = told {
            *self.server.told.lock() = Some(told.clone());
        }
        let told = self.server.told.lock().clone();
        Ok(Held { is_held, told, by: None })
    }

    async fn release(&self) {
        self.server.held.lock().take_if(|(owner, _)| *owner == self.owner);
    }

    fn describe(&self) -> String {
        "memory".to_owned()
    }
}

struct Worker {
    leadership: Leadership,
    tasks: JoinSet<()>,
}

impl Worker {
    fn start(server: &Arc<Server>, owner: &str) -> Self {
        let (mut holder, leadership) = leadership();
        let lease = Arc::new(OnServer { server: Arc::clone(server), owner: owner.to_owned() });
        let mut tasks = JoinSet::new();
        tasks.spawn(async move { keep(lease, TIME, &mut holder).await });
        Self { leadership, tasks }
    }

    async fn leads(&mut self) {
        self.leadership.leader.wait_for(Option::is_some).await.unwrap();
        assert!(self.leadership.term.is_on());
    }

    fn is_leader(&self) -> bool {
        self.leadership.leader.borrow().is_some()
    }
}

fn mark(revision: u64) -> Mark {
    Mark { store_id: "s".to_owned(), revision }
}

#[tokio::test(start_paused = true)]
async fn the_other_one_takes_over_within_one_lease_and_there_are_never_two() {
    let server = Arc::new(Server::default());
    let mut one = Worker::start(&server, "one");
    one.leads().await;
    let mut other = Worker::start(&server, "other");
    tokio::time::sleep(TIME * 3).await;
    assert!(one.is_leader() && !other.is_leader());
    let died = Instant::now();
    drop(one.tasks);
    other.leads().await;
    assert!(died.elapsed() <= TIME, "{:?}", died.elapsed());
    assert!(!one.leadership.term.is_on(), "also where nobody said that it was over");
}

#[tokio::test(start_paused = true)]
async fn whoever_cannot_renew_it_stops_before_another_may_begin() {
    let server = Arc::new(Server::default());
    let mut one = Worker::start(&server, "one");
    one.leads().await;
    *server.is_away.lock() = true;
    let until = server.held.lock().as_ref().unwrap().1;
    one.leadership.leader.wait_for(Option::is_none).await.unwrap();
    assert!(Instant::now() <= until && !one.leadership.term.is_on());
    *server.is_away.lock() = false;
    one.leads().await;
}

#[tokio::test(start_paused = true)]
async fn the_mark_of_who_leads_is_there_before_the_next_one_does() {
    let server = Arc::new(Server::default());
    let mut one = Worker::start(&server, "one");
    one.leads().await;
    one.leadership.told.send_replace(Some(mark(7)));
    let mut other = Worker::start(&server, "other");
    other.leadership.told.send_replace(Some(mark(99)));
    let wait = other.leadership.noted.wait_for(|noted| *noted == Some(mark(7)));
    tokio::time::timeout(TIME, wait).await.expect("who waits sees it").unwrap();
    one.leadership.told.send_replace(Some(mark(8)));
    tokio::time::sleep(TIME).await;
    drop(one.tasks);
    other.leads().await;
    assert_eq!(*other.leadership.noted.borrow(), Some(mark(8)));
}

#[tokio::test(start_paused = true)]
async fn two_terms_are_told_apart_also_if_nobody_looked_in_between() {
    let (mut holder, leadership) = leadership();
    holder.lead(Some(Instant::now() + TIME));
    let first = *leadership.leader.borrow();
    holder.lead(Some(Instant::now() + TIME));
    assert_eq!(*leadership.leader.borrow(), first, "it goes on");
    holder.lead(None);
    holder.lead(Some(Instant::now() + TIME));
    let second = *leadership.leader.borrow();
    assert!(first.is_some() && second.is_some() && first != second);
}

#[tokio::test(start_paused = true)]
async fn a_term_is_over_by_itself() {
    let (mut holder, leadership) = leadership();
    holder.lead(Some(Instant::now() + TIME));
    assert!(leadership.term.is_on());
    tokio::time::advance(TIME).await;
    assert!(!leadership.term.is_on(), "whoever was stopped has not said so yet");
    assert!(leadership.leader.borrow().is_some());
    holder.lead(Some(Instant::now()));
    assert_eq!(*leadership.leader.borrow(), None);
    assert!(Leadership::alone().term.is_on());
}

#[tokio::test(start_paused = true)]
async fn what_is_given_up_is_had_at_once() {
    let server = Arc::new(Server::default());
    let (mut holder, leadership) = leadership();
    let lease = Arc::new(OnServer { server: Arc::clone(&server), owner: "one".to_owned() });
    let mut leader = leadership.leader.clone();
    tokio::select! {
        () = keep(
            Arc::clone(&lease) as Arc<dyn Lease>,
            TIME,
            &mut holder,
        ) => unreachable!("for ever"),
        led = leader.wait_for(Option::is_some) => assert!(led.is_ok()),
    }
    let mut other = Worker::start(&server, "other");
    give_up(&*lease, &mut holder).await;
    assert!(!leadership.term.is_on());
    let start = Instant::now();
    other.leads().await;
    assert!(start.elapsed() <= TIME / 20);
}
