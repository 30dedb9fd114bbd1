use super::*;
use blaze_domain::control::{AdvertiseMessage, RequestMessage};
use serde_json::Value;

struct Bench {
    book: LeaseBook,
    now: Instant,
}

impl Bench {
    fn new() -> Self {
        let reply_to = "blaze/reply/d".parse().unwrap();
        let book = LeaseBook::new(reply_to, "p".into(), 15, Box::new(|| 0.5));
        Self { book, now: Instant::now() }
    }

    fn ask(&mut self, topic: &str, rate_hz: f64) -> (Claim, oneshot::Receiver<AskResult>) {
        let (answer, answered) = oneshot::channel();
        let mut message = AdvertiseMessage::new(topic.parse().unwrap(), "driver".parse().unwrap());
        (message.common.epoch, message.rate_hz) = (7, Some(rate_hz));
        let message = ControlMessage::Advertise(message);
        (self.book.ask(message, answer, self.now).unwrap(), answered)
    }

    fn after(&mut self, ms: u64) -> Vec<Value> {
        self.now += Duration::from_millis(ms);
        self.book.poll(self.now).iter().map(ControlMessage::to_json).collect()
    }

    fn answer(&mut self, sent: &Value, json: &str) {
        let mut answer: Answer = serde_json::from_str(json).unwrap();
        answer.id = sent["id"].as_str().map(str::to_owned);
        self.book.on_answer(&answer, self.now);
    }

    fn agree(&mut self, sent: &Value) {
        self.answer(sent, r#"{"ok":true,"flow":"edge/robot-1","lease_s":15}"#);
    }

    fn held(&mut self, topic: &str) -> (Claim, Value) {
        let (claim, mut answered) = self.ask(topic, 50.0);
        let sent = self.after(0).remove(0);
        self.agree(&sent);
        assert_eq!(answered.try_recv().unwrap(), Ok(()));
        (claim, sent)
    }
}

fn request(topic: &str) -> ControlMessage {
    ControlMessage::Request(RequestMessage::new(topic.parse().unwrap(), "driver".parse().unwrap()))
}

const REFUSED: &str =
    r#"{"ok":false,"error":{"code":"invalid_value","pointer":"/2/rate_hz","detail":"no"}}"#;
const STALE: &str =
    r#"{"ok":false,"error":{"code":"stale_epoch","pointer":"/epoch","detail":"newer"}}"#;

#[test]
fn it_asks_again_with_the_same_id_and_growing_pauses() {
    let mut bench = Bench::new();
    let (claim, _answered) = bench.ask("imu/data", 50.0);
    let first = bench.after(0).remove(0);
    assert_eq!(
        (&first["op"], &first["ttl_s"], &first["epoch"]),
        (&"advertise".into(), &15.into(), &7.into())
    );
    let mut sent_at = vec![bench.now];
    while sent_at.len() < 8 {
        for again in bench.after(10) {
            assert_eq!(again, first);
            sent_at.push(bench.now);
        }
    }
    let pauses: Vec<u128> =
        sent_at.windows(2).map(|pair| (pair[1] - pair[0]).as_millis()).collect();
    assert_eq!(pauses, [250, 500, 1_000, 2_000, 4_000, 5_000, 5_000]);
    assert_eq!(bench.book.attempts(&claim), 8);
    assert_eq!(bench.book.state(&claim), LeaseState::Asking);
}

#[test]
fn it_renews_at_a_third_of_the_time_to_live() {
    let mut bench = Bench::new();
    let (claim, _) = bench.held("imu/data");
    assert_eq!(bench.book.state(&claim), LeaseState::Held);
    for _ in 0..3 {
        assert!(bench.after(4_970).is_empty());
        let renewal = bench.after(30);
        assert_eq!(renewal.len(), 1);
        assert_eq!(renewal[0]["op"], "advertise");
        bench.agree(&renewal[0]);
    }
}

#[test]
fn an_endless_lease_is_sent_again_only_when_a_flow_starts() {
    let mut bench = Bench::new();
    let (_claim, _answered) = bench.ask("imu/data", 50.0);
    let sent = bench.after(0).remove(0);
    bench.answer(&sent, r#"{"ok":true,"lease_s":0}"#);
    assert_eq!(bench.book.next_due(), None);
    bench.book.send_all_again(bench.now);
    assert_eq!(bench.after(200).len(), 1);
}

#[test]
fn a_returning_flow_hears_of_all_leases_within_250_ms() {
    for random in [0.0, 1.0] {
        let mut bench = Bench::new();
        bench.book.random = Box::new(move || random);
        for topic in ["a", "b", "c"] {
            bench.held(topic);
        }
        bench.book.send_all_again(bench.now);
        let soon = bench.after(if random == 0.0 { 0 } else { 170 }).len();
        assert_eq!(soon, if random == 0.0 { 3 } else { 0 }, "jitter {random}");
        assert_eq!(soon + bench.after(50).len(), 3);
        assert!(bench.after(100).is_empty(), "once is enough");
    }
}

#[test]
fn a_refusal_tells_code_and_pointer_and_leaves_nothing() {
    let mut bench = Bench::new();
    let (claim, mut answered) = bench.ask("imu/data", 50.0);
    let sent = bench.after(0).remove(0);
    bench.answer(&sent, REFUSED);
    let Err(FlowError::Refused { code, pointer, detail, .. }) = answered.try_recv().unwrap() else {
        panic!("it was refused");
    };
    assert_eq!(
        (code, pointer.as_str(), detail.as_str()),
        (ErrorCode::InvalidValue, "/rate_hz", "no")
    );
    assert_eq!(bench.book.state(&claim), LeaseState::Ended);
    assert!(bench.book.is_empty() && bench.book.by_id.is_empty());
    bench.book.leave(&claim, None, bench.now);
    assert!(bench.after(10_000).is_empty(), "there is nothing to withdraw");
}

#[test]
fn refused_terms_leave_those_agreed_before() {
    let mut bench = Bench::new();
    let (first, _) = bench.held("imu/data");
    let (second, mut answered) = bench.ask("imu/data", 1e9);
    let sent = bench.after(0).remove(0);
    assert_eq!(sent["rate_hz"], 1e9);
    bench.answer(&sent, REFUSED);
    assert!(answered.try_recv().unwrap().is_err());
    bench.book.leave(&second, None, bench.now);
    assert_eq!(bench.book.state(&first), LeaseState::Held);
    let renewal = bench.after(5_000).remove(0);
    assert_eq!((&renewal["op"], &renewal["rate_hz"]), (&"advertise".into(), &50.0.into()));
}

#[test]
fn the_last_holder_withdraws_and_a_lost_withdraw_is_sent_again_a_few_times() {
    let mut bench = Bench::new();
    let (first, _) = bench.held("imu/data");
    let (second, _) = bench.held("imu/data");
    bench.book.leave(&first, None, bench.now);
    assert!(bench.after(0).is_empty(), "one holder is left");
    let (done, mut answered) = oneshot::channel();
    bench.book.leave(&second, Some(done), bench.now);
    let mut withdraws = Vec::new();
    for _ in 0..2_000 {
        withdraws.extend(bench.after(10));
    }
    assert_eq!(withdraws.len(), 4);
    assert!(withdraws.iter().all(|sent| sent["op"] == "withdraw" && sent["kind"] == "advertise"));
    assert_eq!(answered.try_recv().unwrap(), Err(FlowError::NoAnswer { attempts: 4 }));
    assert!(bench.book.is_empty() && bench.book.by_id.is_empty());
}

#[test]
fn an_answered_withdraw_ends_it_and_a_late_claim_does_no_harm() {
    let mut bench = Bench::new();
    let (old, _) = bench.held("imu/data");
    let (done, mut answered) = oneshot::channel();
    bench.book.leave(&old, Some(done), bench.now);
    let sent = bench.after(0).remove(0);
    bench.agree(&sent);
    assert_eq!(answered.try_recv().unwrap(), Ok(()));
    let (new, _) = bench.held("imu/data");
    bench.book.leave(&old, None, bench.now);
    assert_eq!(bench.book.state(&new), LeaseState::Held);
    assert_eq!(bench.book.state(&old), LeaseState::Ended);
}

#[test]
fn asking_while_a_withdraw_is_under_way_makes_a_new_lease() {
    let mut bench = Bench::new();
    let (old, _) = bench.held("imu/data");
    bench.book.leave(&old, None, bench.now);
    let withdraw = bench.after(0).remove(0);
    let (new, _answered) = bench.ask("imu/data", 50.0);
    bench.agree(&withdraw);
    assert_eq!(bench.book.state(&new), LeaseState::Asking, "the answer was to the withdraw");
    let sent = bench.after(0);
    assert_eq!((sent.len(), &sent[0]["op"]), (1, &"advertise".into()));
}

#[test]
fn a_newer_process_of_the_same_identity_takes_the_lease() {
    let mut bench = Bench::new();
    let (claim, _) = bench.held("imu/data");
    let renewal = bench.after(5_000).remove(0);
    bench.answer(&renewal, STALE);
    assert_eq!(bench.book.state(&claim), LeaseState::Ended);
    // Until that one has ended.
    for _ in 0..3 {
        assert!(bench.after(4_000).is_empty());
        let asked = bench.after(1_000).remove(0);
        bench.answer(&asked, STALE);
    }
    let asked = bench.after(5_000).remove(0);
    bench.agree(&asked);
    assert_eq!(bench.book.state(&claim), LeaseState::Held);
    assert_eq!(bench.after(5_000).len(), 1);
}

#[test]
fn one_that_begins_as_the_older_process_is_told_so() {
    let mut bench = Bench::new();
    let (claim, mut answered) = bench.ask("imu/data", 50.0);
    let sent = bench.after(0).remove(0);
    bench.answer(&sent, STALE);
    assert!(matches!(answered.try_recv().unwrap(), Err(FlowError::Refused { .. })));
    assert_eq!(bench.book.state(&claim), LeaseState::Ended);
    assert!(bench.after(60_000).is_empty());
}

#[test]
fn what_no_flow_ever_heard_of_is_not_withdrawn() {
    let mut bench = Bench::new();
    let (claim, mut answered) = bench.ask("imu/data", 50.0);
    bench.book.leave(&claim, None, bench.now);
    assert_eq!(answered.try_recv().unwrap(), Err(FlowError::Closed));
    assert!(bench.after(10_000).is_empty() && bench.book.is_empty());
}

#[test]
fn leaving_withdraws_all_and_takes_nothing_new() {
    let mut bench = Bench::new();
    for topic in ["a", "b", "c"] {
        bench.held(topic);
    }
    bench.book.leave_all(bench.now);
    let withdraws = bench.after(0);
    assert_eq!(withdraws.len(), 3);
    for sent in &withdraws {
        bench.agree(sent);
    }
    assert!(bench.book.is_empty());
    let refused = bench.book.ask(request("a"), oneshot::channel().0, bench.now);
    assert_eq!(refused.unwrap_err(), FlowError::Closed);
}

#[test]
fn leases_are_bounded() {
    let mut bench = Bench::new();
    let mut answers = Vec::new();
    for number in 0..MAX_LEASES {
        answers.push(bench.ask(&format!("t/{number}"), 1.0));
    }
    let refused = bench.book.ask(request("one/more"), oneshot::channel().0, bench.now);
    assert_eq!(refused.unwrap_err(), FlowError::TooManyLeases(MAX_LEASES));
}
