//! Labels from several threads, limits, and a scrape over HTTP.

use std::error::Error;
use std::net::Ipv4Addr;
use std::time::Duration;

use blaze_brokers::memory::MemoryHub;
use blaze_brokers::{Broker, Content};
use blaze_domain::{DropReason, Scope, TopicName};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use super::*;
use crate::service::slam;
use crate::{
    Message, PublishOptions, ServiceManager, ServiceOptions, ServiceState, SubscribeOptions,
};

const DEADLINE: Duration = Duration::from_secs(20);
const REFUSED: &str = "blaze_sdk_label_sets_refused_total";

fn monitor() -> MonitorManager {
    MonitorManager::new(&slam(), "1.2.3").unwrap()
}

/// The value of a series, written as in the text.
fn value(text: &str, series: &str) -> Option<f64> {
    let value = |line: &str| line.strip_prefix(series)?.strip_prefix(' ')?.parse().ok();
    text.lines().find_map(value)
}

fn series_of<'t>(text: &'t str, name: &str) -> Vec<&'t str> {
    text.lines().filter(|line| line.starts_with(name)).collect()
}

fn is_option<T>(result: &Result<T, SdkError>, part: &str) -> bool {
    matches!(result, Err(SdkError::Option { option: "metric", reason }) if reason.contains(part))
}

#[test]
fn threads_that_make_up_labels_fill_the_limit_and_lose_no_count() {
    const THREADS: usize = 4;
    const EACH: usize = 700;
    let monitor = monitor();
    let count = monitor.counter("seen_total", "Seen.", &["who", "which"]).unwrap();
    let shared = count.labels(&["all", "same"]);
    std::thread::scope(|scope| {
        for thread in 0..THREADS {
            let (count, shared) = (&count, &shared);
            scope.spawn(move || {
                for number in 0..EACH {
                    count.labels(&[&thread.to_string(), &number.to_string()]).inc();
                    count.labels(&["all", "same"]).inc();
                    shared.inc_by(0.5);
                }
            });
        }
        // A scrape meanwhile.
        assert!(series_of(&monitor.text(), "seen_total").len() <= limits::MAX_LABEL_SETS + 1);
    });
    let text = monitor.text();
    let series = series_of(&text, "seen_total");
    assert_eq!(series.len(), limits::MAX_LABEL_SETS + 1, "and the one of all others");
    let other = value(&text, "seen_total{who=\"_other\",which=\"_other\"}").unwrap();
    let beyond = (THREADS * EACH + 1 - limits::MAX_LABEL_SETS) as f64;
    assert_eq!(other, beyond);
    assert_eq!(value(&text, &format!("{REFUSED}{{metric=\"seen_total\"}}")), Some(beyond));
    let same = value(&text, "seen_total{who=\"all\",which=\"same\"}").unwrap();
    assert_eq!(same, (THREADS * EACH) as f64 * 1.5);
    let sum: f64 = series.iter().map(|line| line.rsplit(' ').next().unwrap()).map(number).sum();
    assert_eq!(sum, (THREADS * EACH) as f64 * 2.5, "nothing is lost");
}

fn number(text: &str) -> f64 {
    text.parse().unwrap()
}

#[test]
fn label_sets_that_differ_are_different_series_and_values_are_cut_between_characters() {
    let monitor = monitor();
    let gauge = monitor.gauge("lag", "Lag.", &["a", "b"]).unwrap();
    gauge.labels(&["ab", "c"]).set(1.0);
    gauge.labels(&["a", "bc"]).set(2.0);
    let long = format!("x{}", "é".repeat(100));
    gauge.labels(&[&long, "\"\n"]).add(-3.0);
    gauge.labels(&[&format!("{long}y"), "\"\n"]).add(-1.0);
    gauge.labels(&["_other", "_other"]).set(7.0);
    let text = monitor.text();
    assert_eq!(value(&text, "lag{a=\"ab\",b=\"c\"}"), Some(1.0));
    assert_eq!(value(&text, "lag{a=\"a\",b=\"bc\"}"), Some(2.0));
    let cut = format!("x{}", "é".repeat(63));
    assert_eq!(value(&text, &format!("lag{{a=\"{cut}\",b=\"\\\"\\n\"}}")), Some(-4.0));
    assert_eq!(value(&text, "lag{a=\"_other\",b=\"_other\"}"), Some(7.0));
    assert_eq!(value(&text, &format!("{REFUSED}{{metric=\"lag\"}}")), Some(0.0));
    // Another number of values than there are labels.
    gauge.labels(&["a"]).set(8.0);
    gauge.set(9.0);
    let text = monitor.text();
    assert_eq!(value(&text, "lag{a=\"_other\",b=\"_other\"}"), Some(9.0));
    assert_eq!(value(&text, &format!("{REFUSED}{{metric=\"lag\"}}")), Some(2.0));
}

#[test]
fn a_name_is_one_metric_of_one_shape() {
    let monitor = monitor();
    let first = monitor.counter("jobs_total", "Jobs.", &[]).unwrap();
    monitor.counter("jobs_total", "Jobs again.", &[]).unwrap().inc_by(2.5);
    first.inc();
    for number in [f64::NAN, f64::INFINITY, -1.0, 0.0] {
        first.inc_by(number);
    }
    assert_eq!(value(&monitor.text(), "jobs_total"), Some(3.5));
    assert!(is_option(&monitor.counter("jobs_total", "Jobs.", &["by"]), "another kind"));
    assert!(is_option(&monitor.gauge("jobs_total", "Jobs.", &[]), "another kind"));

    let times = monitor.histogram("wait_seconds", "Waits.", &[], Some(&[0.1, 1.0])).unwrap();
    [0.1, 0.5, 7.0, f64::NAN].into_iter().for_each(|time| times.observe(time));
    let other = monitor.histogram("wait_seconds", "Waits.", &[], Some(&[0.1, 2.0]));
    assert!(is_option(&other, "buckets"));
    assert!(is_option(&monitor.gauge("wait_seconds_count", "Waits.", &[]), "clashes"));
    monitor.gauge("idle_seconds_sum", "Idle.", &[]).unwrap();
    assert!(is_option(&monitor.histogram("idle_seconds", "Idle.", &[], None), "clashes"));
    let text = monitor.text();
    let bucket = |bound| value(&text, &format!("wait_seconds_bucket{{le=\"{bound}\"}}"));
    assert_eq!([bucket("0.1"), bucket("1"), bucket("+Inf")], [Some(1.0), Some(2.0), Some(3.0)]);
    assert_eq!(value(&text, "wait_seconds_sum"), Some(7.6));
}

#[test]
fn a_metric_that_may_not_be_is_an_error_with_the_option() {
    let monitor = monitor();
    let long = "a".repeat(limits::MAX_NAME_BYTES + 1);
    for name in ["", "Lag", "9lag", "lag-s", "läg", "lag s", "a:b", &long] {
        assert!(is_option(&monitor.gauge(name, "Lag.", &[]), "names are"), "{name}");
    }
    assert!(is_option(&monitor.gauge("blaze_lag", "Lag.", &[]), "blaze_"));
    assert!(is_option(&monitor.counter("jobs", "Jobs.", &[]), "_total"));
    assert!(is_option(&monitor.gauge("lag", "", &[]), "help"));
    assert!(is_option(&monitor.gauge("lag", "Lag.", &["a", "a"]), "twice"));
    assert!(is_option(&monitor.gauge("lag", "Lag.", &["__name__"]), "Prometheus"));
    assert!(is_option(&monitor.histogram("lag", "Lag.", &["le"], None), "Prometheus"));
    let labels = ["a", "b", "c", "d", "e", "f", "g", "h", "i"];
    assert!(is_option(&monitor.gauge("lag", "Lag.", &labels), "9 labels"));
    monitor.gauge("lag", "Lag.", &labels[..8]).unwrap();
    for buckets in [&[][..], &[1.0, 1.0], &[2.0, 1.0], &[f64::NAN], &[f64::INFINITY], &[0.0; 65]] {
        let refused = monitor.histogram("wait", "Waits.", &[], Some(buckets));
        assert!(is_option(&refused, "buckets"), "{buckets:?}");
    }
}

#[test]
fn there_are_a_thousand_metrics_at_most() {
    let monitor = monitor();
    for number in 0..limits::MAX_METRICS {
        monitor.gauge(&format!("g{number}"), "A gauge.", &[]).unwrap();
    }
    assert!(is_option(&monitor.gauge("more", "A gauge.", &[]), "1000 metrics"));
    monitor.gauge("g7", "A gauge.", &[]).unwrap().set(1.0);
    assert_eq!(value(&monitor.text(), "g7"), Some(1.0));
}

struct Once;

impl Counted for Once {
    fn counts(&self) -> Counts {
        let (messages, dropped) = (BTreeMap::from([("publish", 1)]), BTreeMap::new());
        Counts { messages, dropped, callbacks: None }
    }
}

#[test]
fn topics_above_the_limit_are_counted_together() {
    let monitor = monitor();
    let topics = monitor.topics();
    let count = |number: usize| {
        let topic: TopicName = format!("made/up{number}").parse().unwrap();
        drop(topics.count(&topic, Arc::new(Once)));
        topics.count(&topic, Arc::new(Once))
    };
    let live: Vec<Counting> = (0..limits::MAX_TOPICS + 3).map(count).collect();
    let text = monitor.text();
    let messages = |topic: &str| {
        let labels = format!("{{topic=\"{topic}\",direction=\"publish\"}}");
        value(&text, &format!("{}{labels}", topics::MESSAGES))
    };
    assert_eq!(messages("made/up7"), Some(2.0), "one that lives and one that has ended");
    assert_eq!(messages("_other"), Some(6.0));
    assert_eq!(series_of(&text, topics::MESSAGES).len(), limits::MAX_TOPICS + 1);
    let refused = format!("{REFUSED}{{metric=\"{}\"}}", topics::MESSAGES);
    assert_eq!(value(&text, &refused), Some(6.0));
    drop(live);
    assert_eq!(monitor.text(), text, "what they counted stays");
}

#[test]
fn the_variable_names_an_address_or_nothing() {
    use super::endpoint::named;
    assert_eq!(named(None).unwrap(), None);
    assert_eq!(named(Some("off")).unwrap(), None);
    assert_eq!(named(Some("[::1]:0")).unwrap(), Some("[::1]:0".parse().unwrap()));
    for bad in ["on", "localhost:9200", "127.0.0.1", "127.0.0.1:70000", "9200"] {
        let error = named(Some(bad)).unwrap_err();
        assert!(matches!(error, SdkError::Option { option: "BLAZE_METRICS", .. }), "{error}");
    }
}

fn options(hub: &MemoryHub) -> ServiceOptions {
    let (layer, name) = ("edge".parse().unwrap(), "slam".parse().unwrap());
    let options = ServiceOptions::new(layer, name, Arc::new(hub.broker()), Scope::Node);
    ServiceOptions {
        metrics: MetricsEndpoint::At((Ipv4Addr::LOCALHOST, 0).into()),
        version: "1.2.3".to_owned(),
        pool_threads: 2,
        ..options.on_node("robot-1".parse().unwrap())
    }
}

/// Head and body of an answer.
async fn get(address: &str, path: &str) -> std::io::Result<(String, String)> {
    let mut stream = TcpStream::connect(address).await?;
    let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await?;
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    Ok((head.to_owned(), body.to_owned()))
}

async fn get_until(address: &str, path: &str, is_so: impl Fn(&str, &str) -> bool) -> String {
    let asks = async {
        loop {
            let (head, body) = get(address, path).await.unwrap();
            if is_so(&head, &body) {
                return body;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(DEADLINE, asks).await.unwrap()
}

#[tokio::test]
async fn a_service_is_scraped_and_its_watchdog_names_the_address() -> Result<(), Box<dyn Error>> {
    let hub = MemoryHub::new("node");
    let watcher = hub.broker();
    let channel = "blaze/watchdog".parse()?;
    let mut signs = watcher.subscribe(&channel, blaze_brokers::SubscribeOptions::default()).await?;
    let service = ServiceManager::start(options(&hub)).await?;
    let address = service.monitor().address().unwrap().to_owned();
    assert!(address.starts_with("127.0.0.1:") && !address.ends_with(":0"), "{address}");

    get_until(&address, "/readyz", |head, _| head.starts_with("HTTP/1.1 200")).await;
    service.cache().set_state(ServiceState::Unhealthy);
    get_until(&address, "/readyz", |head, body| {
        head.starts_with("HTTP/1.1 503") && body.contains("unhealthy")
    })
    .await;
    let mut heard = Vec::new();
    tokio::time::timeout(DEADLINE, signs.receive(&mut heard, 1)).await?;
    let Content::Bare { payload, .. } = heard.remove(0).content else { panic!("a bare message") };
    let sign: serde_json::Value = serde_json::from_slice(&payload)?;
    assert_eq!(sign["metrics"], address.as_str());

    // As the example of the page has it.
    let count =
        service.monitor().counter("echo_messages_total", "Messages echoed", &["service"])?;
    let topic: TopicName = "imu/data".parse()?;
    let options = SubscribeOptions { max_messages: 8, ..SubscribeOptions::default() };
    let callback = move |message: Message| count.labels(&[&message.origin().service]).inc();
    let subscription = service.broker().subscribe(&topic, options, callback).await?;
    let publisher = service.broker().publisher(&topic, &PublishOptions::default())?;
    publisher.publish("a".into());
    publisher.publish("b".into());
    publisher.publish(vec![0; blaze_domain::MAX_PAYLOAD_BYTES + 1].into());

    let has_both = |_: &str, text: &str| {
        value(text, "blaze_sdk_callback_seconds_count{topic=\"imu/data\"}") == Some(2.0)
    };
    let text = get_until(&address, "/metrics", has_both).await;
    let info = "blaze_service_info{instance=\"0\",language=\"rust\",layer=\"edge\",\
        node=\"robot-1\",service=\"slam\",version=\"1.2.3\"}";
    assert_eq!(value(&text, info), Some(1.0));
    assert_eq!(value(&text, "echo_messages_total{service=\"slam\"}"), Some(2.0));
    for (series, count) in [
        ("messages_total{topic=\"imu/data\",direction=\"publish\"}", 2.0),
        ("messages_total{topic=\"imu/data\",direction=\"receive\"}", 2.0),
        ("dropped_total{topic=\"imu/data\",reason=\"too_large\"}", 1.0),
        ("dropped_total{topic=\"imu/data\",reason=\"max_rate\"}", 0.0),
        ("callback_seconds_bucket{topic=\"imu/data\",le=\"+Inf\"}", 2.0),
    ] {
        assert_eq!(value(&text, &format!("blaze_sdk_{series}")), Some(count), "{series}");
    }

    // A scrape after they have ended says the same.
    drop(publisher);
    subscription.close().await;
    let of_sdk = |text: &str| series_of(text, "blaze_sdk_").join("\n");
    assert_eq!(of_sdk(&service.monitor().text()), of_sdk(&text));

    service.shutdown().await;
    assert!(get(&address, "/livez").await.is_err(), "the port is closed");
    Ok(())
}

#[tokio::test]
async fn a_port_that_is_taken_is_an_error_and_off_serves_nothing() {
    let hub = MemoryHub::new("node");
    let first = ServiceManager::start(options(&hub)).await.unwrap();
    let taken = first.monitor().address().unwrap().parse().unwrap();
    let second = ServiceOptions { metrics: MetricsEndpoint::At(taken), ..options(&hub) };
    let error = ServiceManager::start(second).await.err().unwrap();
    assert!(matches!(error, SdkError::Option { option: "metrics", .. }), "{error}");

    let off = ServiceOptions { metrics: MetricsEndpoint::Off, ..options(&hub) };
    let off = ServiceManager::start(off).await.unwrap();
    off.monitor().counter("jobs_total", "Jobs.", &[]).unwrap().inc();
    assert_eq!(off.monitor().address(), None);
    assert_eq!(value(&off.monitor().text(), "jobs_total"), Some(1.0));
}

#[test]
fn callbacks_are_counted_in_buckets() {
    let mut times = Times::default();
    for time in [100, 101, 4_999_999, 9_000_000] {
        times.add(Duration::from_micros(time));
    }
    let counts = Counts { callbacks: Some(times), ..Counts::default() };
    struct Fixed(Counts);
    impl Counted for Fixed {
        fn counts(&self) -> Counts {
            self.0.clone()
        }
    }
    let monitor = monitor();
    let dropped = BTreeMap::from([(DropReason::QueueFull, 3)]);
    let topic: TopicName = "imu/data".parse().unwrap();
    let _one = monitor.topics().count(&topic, Arc::new(Fixed(counts.clone())));
    let _two = monitor.topics().count(&topic, Arc::new(Fixed(Counts { dropped, ..counts })));
    let text = monitor.text();
    let bucket = |le: &str| {
        let labels = format!("{{topic=\"imu/data\",le=\"{le}\"}}");
        value(&text, &format!("blaze_sdk_callback_seconds_bucket{labels}"))
    };
    let counted = ["0.0001", "0.0005", "1", "5", "+Inf"].map(bucket);
    assert_eq!(counted, [2.0, 4.0, 4.0, 6.0, 8.0].map(Some));
    let queue_full = "blaze_sdk_dropped_total{topic=\"imu/data\",reason=\"queue_full\"}";
    assert_eq!(value(&text, queue_full), Some(3.0));
}
