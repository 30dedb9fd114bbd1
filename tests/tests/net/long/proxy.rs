//! The fault proxy: each fault is what a client sees.

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::time::{Duration, Instant};

use blaze_tests::machine::Idler;
use blaze_tests::network::{Plan, Topology, connect};
use blaze_tests::proxy::Proxy;
use blaze_tests::wait;
use blaze_tests::wan::Shape;
use blaze_tests::within;

const SOON: Duration = Duration::from_secs(5);
/// Long enough for what would pass to pass.
const NOTHING: Duration = Duration::from_millis(200);

/// A server that sends back what it gets, until the test's process ends.
fn echo() -> anyhow::Result<SocketAddr> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?;
    let address = listener.local_addr()?;
    std::thread::spawn(move || {
        for client in listener.incoming().map_while(Result::ok) {
            std::thread::spawn(move || {
                let mut buffer = [0; 4096];
                let mut client = client;
                while let Ok(length @ 1..) = client.read(&mut buffer) {
                    if client.write_all(&buffer[..length]).is_err() {
                        break;
                    }
                }
            });
        }
    });
    Ok(address)
}

fn client(proxy: &Proxy) -> anyhow::Result<TcpStream> {
    let stream = TcpStream::connect_timeout(&proxy.address(), SOON)?;
    stream.set_read_timeout(Some(SOON))?;
    Ok(stream)
}

/// Sends words and waits until they are back.
fn exchange(stream: &mut TcpStream, words: &[u8]) -> std::io::Result<Duration> {
    let begin = Instant::now();
    stream.write_all(words)?;
    let mut back = vec![0; words.len()];
    stream.read_exact(&mut back)?;
    assert_eq!(back, words);
    Ok(begin.elapsed())
}

#[test]
fn it_forwards_and_counts() -> anyhow::Result<()> {
    let proxy = Proxy::start(echo()?)?;
    let mut stream = client(&proxy)?;
    exchange(&mut stream, b"hello")?;
    let large: Vec<u8> = (0..3_000_000_u32).map(|number| number as u8).collect();
    let mut other = stream.try_clone()?;
    let back = std::thread::scope(|scope| {
        scope.spawn(|| other.write_all(&large));
        let mut back = vec![0; large.len()];
        stream.read_exact(&mut back).map(|()| back)
    })?;
    assert!(back == large);
    // What was read here may not be counted there yet.
    wait::until(
        "all bytes are counted",
        SOON,
        || (proxy.stats().up_bytes, proxy.stats().down_bytes) == (3_000_005, 3_000_005),
        || format!("{:?}", proxy.stats()),
    )?;
    let stats = proxy.stats();
    assert_eq!((stats.accepted, stats.open), (1, 1));
    drop((stream, other));
    wait::until(
        "no connection is open",
        SOON,
        || proxy.stats().open == 0,
        || format!("{:?}", proxy.stats()),
    )?;
    Ok(())
}

#[test]
fn an_end_of_one_side_is_passed_on() -> anyhow::Result<()> {
    let proxy = Proxy::start(echo()?)?;
    let mut stream = client(&proxy)?;
    stream.write_all(b"last words")?;
    stream.shutdown(std::net::Shutdown::Write)?;
    let mut back = Vec::new();
    stream.read_to_end(&mut back)?;
    assert_eq!(back, b"last words");
    Ok(())
}

#[test]
fn a_target_that_is_away_closes_the_connection() -> anyhow::Result<()> {
    let nobody = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?.local_addr()?;
    let proxy = Proxy::start(nobody)?;
    let mut stream = client(&proxy)?;
    assert!(matches!(stream.read(&mut [0; 1]), Ok(0) | Err(_)));
    assert_eq!(proxy.stats().unreached, 1);
    Ok(())
}

#[test]
fn a_delay_is_kept_both_ways() -> anyhow::Result<()> {
    let proxy = Proxy::start(echo()?)?;
    let mut stream = client(&proxy)?;
    exchange(&mut stream, b"before")?;
    proxy.delay(Duration::from_millis(50))?;
    let idler = Idler::start();
    let took = exchange(&mut stream, b"delayed")?;
    let late = idler.latest();
    let delayed = Duration::from_millis(100)..Duration::from_millis(300) + late;
    assert!(delayed.contains(&took), "{took:?}, the machine was late by {late:?}");
    proxy.heal()?;
    // Whatever else the machine does, it is not each time.
    let took: Vec<Duration> = (0..5)
        .map(|_| exchange(&mut stream, b"healed"))
        .collect::<Result<_, _>>()?;
    let fastest = took.iter().min();
    assert!(fastest < Some(&Duration::from_millis(50)), "{took:?}");
    Ok(())
}

#[test]
fn a_throttle_holds_its_rate() -> anyhow::Result<()> {
    let proxy = Proxy::start(echo()?)?;
    let mut stream = client(&proxy)?;
    proxy.throttle(50_000)?;
    // A second up, and the same time down behind it.
    let took = exchange(&mut stream, &vec![7; 50_000])?;
    println!("50,000 bytes at 50,000 bytes/s there and back: {took:?}");
    let limit = within(Duration::from_millis(1_500));
    assert!((Duration::from_millis(950)..limit).contains(&took), "{took:?}");
    proxy.heal()?;
    let took = exchange(&mut stream, &vec![7; 50_000])?;
    assert!(took < Duration::from_millis(900), "the rate is held no more: {took:?}");
    Ok(())
}

#[test]
fn a_cut_closes_and_refuses_until_healed() -> anyhow::Result<()> {
    let proxy = Proxy::start(echo()?)?;
    let mut stream = client(&proxy)?;
    exchange(&mut stream, b"before")?;
    proxy.cut()?;
    assert!(matches!(stream.read(&mut [0; 1]), Ok(0)), "it was closed");
    let refused = TcpStream::connect_timeout(&proxy.address(), SOON).map(|_| ());
    assert_eq!(refused.map_err(|error| error.kind()), Err(ErrorKind::ConnectionRefused));
    assert_eq!(proxy.stats().cut, 1);
    proxy.heal()?;
    exchange(&mut client(&proxy)?, b"after")?;
    Ok(())
}

#[test]
fn stalled_it_accepts_and_is_silent_and_then_goes_on() -> anyhow::Result<()> {
    let proxy = Proxy::start(echo()?)?;
    let mut old = client(&proxy)?;
    exchange(&mut old, b"before")?;
    proxy.stall()?;
    let mut new = client(&proxy)?;
    for stream in [&mut old, &mut new] {
        stream.write_all(b"stalled")?;
        stream.set_read_timeout(Some(NOTHING))?;
        let silent = stream.read(&mut [0; 1]).map_err(|error| error.kind());
        assert!(
            matches!(silent, Err(ErrorKind::WouldBlock | ErrorKind::TimedOut)),
            "{silent:?}"
        );
        stream.set_read_timeout(Some(SOON))?;
    }
    proxy.heal()?;
    for stream in [&mut old, &mut new] {
        let mut back = [0; 7];
        stream.read_exact(&mut back)?;
        assert_eq!(&back, b"stalled");
    }
    assert_eq!(proxy.stats().accepted, 2);
    Ok(())
}

#[test]
fn a_reset_is_a_reset() -> anyhow::Result<()> {
    let proxy = Proxy::start(echo()?)?;
    let mut stream = client(&proxy)?;
    exchange(&mut stream, b"before")?;
    proxy.reset()?;
    let reset = stream.read(&mut [0; 1]).map_err(|error| error.kind());
    assert_eq!(reset, Err(ErrorKind::ConnectionReset));
    wait::until(
        "it is counted",
        SOON,
        || proxy.stats().reset == 1,
        || format!("{:?}", proxy.stats()),
    )?;
    // New connections are treated as before.
    exchange(&mut client(&proxy)?, b"after")?;
    Ok(())
}

#[test]
fn it_works_on_a_host_of_a_network() -> anyhow::Result<()> {
    let network = Topology::build(&Plan::two_hosts("a", "b", Shape::default()))?;
    let (a, b) = (network.host("a")?, network.host("b")?);
    let listener = blaze_tests::network::inside(&b.namespace, || Ok(TcpListener::bind((b.address, 0))?))?;
    let proxy = Proxy::listen_on(a, 0, listener.local_addr()?)?;
    let server = std::thread::spawn(move || -> std::io::Result<()> {
        let (mut stream, _) = listener.accept()?;
        let mut words = [0; 5];
        stream.read_exact(&mut words)?;
        stream.write_all(&words)
    });
    let mut stream = connect(Some(&b.namespace), proxy.address(), SOON)?;
    stream.set_read_timeout(Some(SOON))?;
    exchange(&mut stream, b"hello")?;
    server.join().map_err(|_| anyhow::anyhow!("the server panicked"))??;
    assert_eq!(proxy.address().ip(), a.address);
    Ok(())
}
