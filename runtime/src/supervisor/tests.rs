use std::process::{Command, ExitCode, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::*;
use crate::environment;

const SOON: Duration = Duration::from_secs(10);

async fn soon<F: Future>(what: &str, future: F) -> F::Output {
    match tokio::time::timeout(SOON, future).await {
        Ok(output) => output,
        Err(_) => panic!("{what}: not within {SOON:?}"),
    }
}

async fn failure_of(
    policy: TaskPolicy,
    act: impl FnOnce() -> Result<(), String> + Send + 'static,
) -> Option<String> {
    let supervisor = Supervisor::new("test");
    let handle = supervisor.spawn("pacer", policy, async move { act() });
    soon("end of the task", handle.finished()).await;
    assert!(supervisor.running().is_empty());
    supervisor.failure()
}

#[tokio::test]
async fn the_end_of_an_essential_task_is_a_failure() {
    use TaskPolicy::{Essential, MayEnd};
    assert_eq!(failure_of(Essential, || Ok(())).await.as_deref(), Some("pacer ended unexpectedly"));
    assert_eq!(
        failure_of(Essential, || Err("disk full".into())).await.as_deref(),
        Some("pacer failed: disk full")
    );
    assert_eq!(
        failure_of(Essential, || panic!("no {}", 7)).await.as_deref(),
        Some("pacer panicked: no 7")
    );
    assert_eq!(failure_of(MayEnd, || Ok(())).await, None);
    assert_eq!(failure_of(MayEnd, || Err("disk full".into())).await, None);
    assert_eq!(failure_of(MayEnd, || panic!("bug")).await.as_deref(), Some("pacer panicked: bug"));
}

#[tokio::test]
async fn threads_are_observed_too() {
    let supervisor = Supervisor::new("test");
    let handle = supervisor.spawn_thread("clock", TaskPolicy::MayEnd, || {}).unwrap();
    soon("end of the thread", handle.finished()).await;
    assert_eq!(supervisor.failure(), None);
    let handle = supervisor
        .spawn_thread("clock", TaskPolicy::Essential, || -> () { panic!("tick") })
        .unwrap();
    assert_eq!(soon("failure", supervisor.failed()).await, "clock panicked: tick");
    soon("end of the thread", handle.finished()).await;
}

#[tokio::test]
async fn the_first_reason_stays() {
    let supervisor = Supervisor::new("test");
    supervisor.fail("one");
    supervisor.fail("two");
    assert_eq!(supervisor.failed().await, "one");
}

/// Sets a flag when it is dropped.
struct Flag(Arc<AtomicBool>);

impl Drop for Flag {
    fn drop(&mut self) {
        self.0.store(true, Ordering::SeqCst);
    }
}

#[tokio::test]
async fn a_stopped_task_is_no_failure_and_drops_what_it_held() {
    let supervisor = Supervisor::new("test");
    let dropped = Arc::new(AtomicBool::new(false));
    let flag = Flag(Arc::clone(&dropped));
    let handle = supervisor.spawn("bridge", TaskPolicy::Essential, async move {
        let _flag = flag;
        std::future::pending::<()>().await;
    });
    let running = supervisor.running();
    assert_eq!((running.len(), running[0].name.as_str(), running[0].thread), (1, "bridge", false));
    drop(handle.clone().stop_on_drop());
    soon("end of the task", handle.finished()).await;
    assert!(dropped.load(Ordering::SeqCst));
    assert_eq!(supervisor.failure(), None);
    assert!(supervisor.running().is_empty());
}

#[tokio::test]
async fn the_shutdown_takes_its_steps_in_order_while_tasks_run() {
    let supervisor = Supervisor::new("test");
    let steps = Arc::new(Mutex::new(Vec::new()));
    let step = |name: &'static str| {
        let (steps, supervisor) = (Arc::clone(&steps), supervisor.clone());
        async move {
            assert!(supervisor.stopping_token().is_cancelled());
            assert!(!supervisor.shutdown_token().is_cancelled());
            steps.lock().push(name);
        }
    };
    let token = supervisor.shutdown_token();
    supervisor.spawn("worker", TaskPolicy::Essential, async move { token.cancelled().await });
    let order = ShutdownSteps::new(SOON)
        .on(ShutdownPhase::Drain, "drain", step("drain"))
        .on(ShutdownPhase::NotReady, "readiness", step("not ready"))
        .on(ShutdownPhase::EndStreams, "streams", step("streams"))
        .on(ShutdownPhase::StopAccepting, "port", step("port"));
    let report = supervisor.shutdown_with(order).await;
    assert!(report.is_clean(), "{report:?}");
    assert_eq!(*steps.lock(), ["not ready", "port", "streams", "drain"]);
    assert_eq!(supervisor.failure(), None);
}

#[tokio::test]
async fn the_deadline_aborts_what_is_left() {
    let supervisor = Supervisor::new("test");
    let child = supervisor.child("robot-1");
    let release = CancellationToken::new();
    let held = release.clone();
    supervisor.spawn("stubborn", TaskPolicy::Essential, std::future::pending::<()>());
    child.spawn("stubborn", TaskPolicy::MayEnd, std::future::pending::<()>());
    let runtime = tokio::runtime::Handle::current();
    let thread = supervisor
        .spawn_thread("blocked", TaskPolicy::Essential, move || {
            runtime.block_on(held.cancelled());
        })
        .unwrap();
    let steps = ShutdownSteps::new(Duration::from_millis(100)).on(
        ShutdownPhase::Drain,
        "endless drain",
        std::future::pending(),
    );
    let report = soon("shutdown", supervisor.shutdown_with(steps)).await;
    assert_eq!(report.unfinished_steps, ["endless drain"]);
    assert_eq!(report.aborted, ["stubborn", "robot-1/stubborn"]);
    assert_eq!(report.left, ["blocked"]);
    assert_eq!(supervisor.failure(), None);
    release.cancel();
    soon("end of the thread", thread.finished()).await;
}

#[tokio::test]
async fn a_child_ends_alone_and_fails_with_the_whole() {
    let supervisor = Supervisor::new("demo");
    let (one, two) = (supervisor.child("robot-1"), supervisor.child("fog-1"));
    for child in [&one, &two] {
        let token = child.shutdown_token();
        child.spawn("flow", TaskPolicy::Essential, async move { token.cancelled().await });
    }
    assert!(one.shutdown(SOON).await.is_clean());
    let names: Vec<String> = supervisor.running().into_iter().map(|task| task.name).collect();
    assert_eq!(names, ["fog-1/flow"]);
    two.fail("link broke");
    assert_eq!(soon("failure", supervisor.failed()).await, "fog-1: link broke");
    assert_eq!(one.failure(), None);
    assert!(supervisor.shutdown(SOON).await.is_clean());
    assert!(two.shutdown_token().is_cancelled());
}

#[tokio::test]
async fn tasks_can_be_spawned_from_threads() {
    let supervisor = Supervisor::new("test");
    let inner = supervisor.clone();
    let (tell, told) = tokio::sync::oneshot::channel();
    supervisor
        .spawn_thread("dds", TaskPolicy::MayEnd, move || {
            inner.spawn("reader", TaskPolicy::MayEnd, async move {
                let _ = tell.send(7);
            });
        })
        .unwrap();
    assert_eq!(soon("answer", told).await.unwrap(), 7);
}

/// The scenario that [`child_process`] plays, in a process of its own because it is about signals
/// and exit codes.
const SCENARIO: &str = "BLAZE_TEST_SUPERVISOR_SCENARIO";

#[test]
#[ignore = "started by the tests below as a process of its own"]
fn child_process() {
    let Some(scenario) = environment::variable(SCENARIO) else {
        return;
    };
    let code = block_on("blaze-test", async {
        let supervisor = Supervisor::new("blaze-test");
        let token = supervisor.shutdown_token();
        supervisor.spawn("worker", TaskPolicy::Essential, async move { token.cancelled().await });
        let mut steps = ShutdownSteps::new(Duration::from_secs(60));
        match scenario.as_str() {
            "hang" => {
                steps = steps.on(ShutdownPhase::Drain, "drain", async {
                    crate::supervisor::say(format_args!("draining"));
                    std::future::pending::<()>().await;
                });
            }
            "fail" => {
                supervisor.spawn("pacer", TaskPolicy::Essential, async {});
            }
            _ => {}
        }
        // The handlers are set before the first await of `run` that waits.
        let tell = async { crate::supervisor::say(format_args!("running")) };
        let (code, ()) = futures_join(supervisor.run(steps), tell).await;
        code
    });
    std::process::exit(if code == ExitCode::SUCCESS { 0 } else { 1 });
}

/// Both, the first polled first.
async fn futures_join<A: Future, B: Future>(a: A, b: B) -> (A::Output, B::Output) {
    tokio::join!(biased; a, b)
}

/// Starts the scenario; for each line that stderr must say, sends the signal that goes with it.
fn play(scenario: &str, signals: &[(&str, &str)]) -> (ExitStatus, String) {
    use std::io::{BufRead, BufReader};
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "supervisor::tests::child_process", "--ignored", "--nocapture"])
        .env(SCENARIO, scenario)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = String::new();
    let mut signals = signals.iter();
    let mut next = signals.next();
    for line in BufReader::new(child.stderr.take().unwrap()).lines() {
        let line = line.unwrap();
        if let Some((_, signal)) = next.filter(|(expected, _)| line.contains(expected)) {
            let sent =
                Command::new("kill").args([*signal, &child.id().to_string()]).status().unwrap();
            assert!(sent.success());
            next = signals.next();
        }
        said += &(line + "\n");
    }
    (child.wait().unwrap(), said)
}

#[test]
fn a_signal_ends_with_0() {
    for signal in ["-TERM", "-INT"] {
        let (status, said) = play("idle", &[("running", signal)]);
        assert_eq!(status.code(), Some(0), "{said}");
    }
}

#[test]
fn a_failed_task_ends_with_1_and_one_line() {
    let (status, said) = play("fail", &[]);
    assert_eq!(status.code(), Some(1), "{said}");
    assert_eq!(
        said.lines().filter(|line| *line == "blaze-test failed: pacer ended unexpectedly").count(),
        1,
        "{said}"
    );
}

#[test]
fn a_second_signal_exits_at_once() {
    let started = Instant::now();
    let (status, said) = play("hang", &[("running", "-TERM"), ("draining", "-TERM")]);
    assert_eq!(status.code(), Some(143), "{said}");
    // Far below the deadline of the shutdown.
    assert!(started.elapsed() < Duration::from_secs(30));
}
