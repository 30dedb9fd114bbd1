//! Garbage at the admin port: halves, floods, and clients that never finish.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use blaze_tests::admin::Admin;
use blaze_tests::wait;

use super::node_file::{DEADLINE, small_file, started};
use super::random::Random;

/// A flow whose port everybody storms may not grow beyond this.
const MAX_GROWTH: u64 = 64 * 1024 * 1024;

fn connect(address: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect_timeout(&address, Duration::from_secs(5)).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(8))).unwrap();
    stream.set_write_timeout(Some(Duration::from_secs(8))).unwrap();
    stream
}

/// Sends bytes, closes the writing half and gives what comes back. The other side may hang up at any moment.
fn throw(address: SocketAddr, bytes: &[u8]) -> Vec<u8> {
    let mut stream = connect(address);
    let _ = stream.write_all(bytes);
    let _ = stream.shutdown(std::net::Shutdown::Write);
    let mut answer = Vec::new();
    let _ = stream.take(1 << 20).read_to_end(&mut answer);
    answer
}

fn connections(admin: &Admin, result: &str) -> f64 {
    let label = format!("result=\"{result}\"");
    admin.metric("blaze_admin_connections_total", &[&label]).unwrap_or(-1.0)
}

fn no_requests() -> Vec<Vec<u8>> {
    let mut random = Random::new(5);
    let mut all: Vec<Vec<u8>> = [
        "GET /livez",
        "GET /livez HTTP/1.1",
        "GET /livez HTTP/1.1\r\nHost: x\r\n",
        "GET  /livez HTTP/9.9\r\n\r\n",
        "GET /livez HTTP/1.1\r\nContent-Length: 99999999999999999999\r\n\r\n",
        "GET /livez HTTP/1.1\r\nContent-Length: 5\r\nContent-Length: 6\r\n\r\n",
        "POST /v1/why HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\nffffffffffffffff\r\n",
        "POST /livez HTTP/1.1\r\nHost: x\r\nContent-Length: 1000000\r\n\r\nshort",
        "\r\n\r\n\r\n\r\n",
        "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        "\u{16}\u{3}\u{1}\u{2}\u{0}\u{1}\u{0}\u{1}\u{fc}\u{3}\u{3}",
        "GET /v1/why?topic=%%%%%%%%%%%%%%% HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n",
        "DELETE /v1/topics HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n",
    ]
    .iter()
    .map(|text| text.as_bytes().to_vec())
    .collect();
    let header = format!("GET /livez HTTP/1.1\r\nX-Long: {}\r\n\r\n", "x".repeat(1 << 20));
    let many = format!("GET /livez HTTP/1.1\r\n{}\r\n", "X: y\r\n".repeat(100_000));
    let path = format!("GET /{} HTTP/1.1\r\nHost: x\r\n\r\n", "x".repeat(1 << 20));
    let question = format!(
        "GET /v1/why?topic={} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n",
        "x".repeat(8000)
    );
    all.extend([header, many, path, question].map(String::into_bytes));
    for _ in 0..100 {
        let count = 1 + random.below(3000);
        all.push(random.bytes(count));
        let mut noise = b"GET /v1/topics HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n".to_vec();
        let at = random.below(noise.len());
        noise[at] ^= 1 << random.below(8);
        all.push(noise);
    }
    all
}

#[test]
fn what_is_no_http_is_counted_and_the_port_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("blaze.yaml");
    std::fs::write(&file, small_file(folder.path(), "40")).unwrap();
    let (mut process, admin) = started(&["--config", &file.display().to_string()]);
    let before = process.resident_bytes().unwrap();
    for garbage in no_requests() {
        let answer = throw(admin.address, &garbage);
        // Whatever it was, the answer is HTTP or nothing.
        assert!(
            answer.is_empty() || answer.starts_with(b"HTTP/1."),
            "{}",
            String::from_utf8_lossy(&answer)
        );
    }
    assert!(process.runs(), "{}", process.tail());
    assert!(admin.ready());
    assert!(
        connections(&admin, "malformed") >= 50.0,
        "{} malformed",
        connections(&admin, "malformed")
    );
    assert_eq!(connections(&admin, "panicked"), 0.0);
    let after = process.resident_bytes().unwrap();
    assert!(after < before + MAX_GROWTH, "{before} bytes before, {after} after");
    assert_eq!(process.terminate(DEADLINE).unwrap(), Some(0));
}

#[test]
fn a_thousand_connections_and_slow_clients_end_by_themselves() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("blaze.yaml");
    std::fs::write(&file, small_file(folder.path(), "40")).unwrap();
    let (mut process, admin) = started(&["--config", &file.display().to_string()]);
    let before = process.resident_bytes().unwrap();
    // 1,000 that begin a request and do not end it; those that are served get a byte now and then.
    let mut open: Vec<TcpStream> = (0..1000)
        .filter_map(|_| TcpStream::connect_timeout(&admin.address, Duration::from_secs(5)).ok())
        .collect();
    assert!(open.len() >= 900, "only {} connections", open.len());
    for stream in &mut open {
        stream.set_nonblocking(true).unwrap();
        let _ = stream.write_all(b"GET /livez HTTP/1.1\r\nX: ");
    }
    let begin = Instant::now();
    wait::until(
        "the port answers again",
        DEADLINE,
        || {
            for stream in &mut open {
                let _ = stream.write(b"x");
            }
            admin.ready()
        },
        || process.tail(),
    )
    .unwrap();
    // Heads have five seconds.
    assert!(begin.elapsed() < Duration::from_secs(9), "{:?}", begin.elapsed());
    assert!(
        connections(&admin, "refused") >= 500.0,
        "{} refused",
        connections(&admin, "refused")
    );
    let timed_out = || connections(&admin, "timed_out") >= 200.0;
    wait::until("slow ones are counted", DEADLINE, timed_out, || {
        format!("{}", connections(&admin, "timed_out"))
    })
    .unwrap();
    let after = process.resident_bytes().unwrap();
    assert!(after < before + MAX_GROWTH, "{before} bytes before, {after} after");
    eprintln!(
        "answered again after {:?}; {} KiB more",
        begin.elapsed(),
        after.saturating_sub(before) / 1024
    );
    drop(open);
    assert_eq!(process.terminate(DEADLINE).unwrap(), Some(0));
}
