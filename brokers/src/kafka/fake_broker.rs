//! A server for tests that answers questions for metadata, and sometimes names no broker: so does a
//! real one that has lost itself for a moment, after a pause or while it starts.

use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// Identity of the only broker.
const BROKER: i32 = 1;
const METADATA: i16 = 3;
const API_VERSIONS: i16 = 18;
/// A version that the server does not know.
const UNSUPPORTED_VERSION: i16 = 35;
const LEADER_NOT_AVAILABLE: i16 = 5;

#[derive(Default)]
struct State {
    silent: AtomicBool,
    lost: AtomicBool,
    /// Answers without a broker so far.
    lost_answers: AtomicUsize,
}

/// It listens until the process ends.
pub(super) struct FakeBroker {
    port: u16,
    state: Arc<State>,
}

impl FakeBroker {
    pub(super) fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let state = Arc::<State>::default();
        let shared = Arc::clone(&state);
        std::thread::spawn(move || {
            let shared = &shared;
            for stream in listener.incoming().flatten() {
                let shared = Arc::clone(shared);
                std::thread::spawn(move || serve(stream, port, &shared));
            }
        });
        Self { port, state }
    }

    pub(super) fn bootstrap(&self) -> String {
        format!("127.0.0.1:{}", self.port)
    }

    /// From now on its answers name no broker, or name itself again.
    pub(super) fn set_lost(&self, lost: bool) {
        self.state.lost.store(lost, Ordering::SeqCst);
    }

    /// From now on it says nothing, or goes on.
    pub(super) fn set_silent(&self, silent: bool) {
        self.state.silent.store(silent, Ordering::SeqCst);
    }

    /// Answers without a broker so far.
    pub(super) fn lost_answers(&self) -> usize {
        self.state.lost_answers.load(Ordering::SeqCst)
    }
}

/// Answers until the client goes. `None`: it has gone.
fn serve(mut stream: TcpStream, port: u16, state: &State) -> Option<()> {
    loop {
        let mut length = [0; 4];
        stream.read_exact(&mut length).ok()?;
        let mut request = vec![0; usize::try_from(i32::from_be_bytes(length)).ok()?];
        stream.read_exact(&mut request).ok()?;
        while state.silent.load(Ordering::SeqCst) {
            std::thread::sleep(std::time::Duration::from_millis(10));
        }
        let number =
            |at: usize| Some(i16::from_be_bytes(request.get(at..at + 2)?.try_into().ok()?));
        let (key, version) = (number(0)?, number(2)?);
        let mut answer = request.get(4..8)?.to_vec();
        match key {
            API_VERSIONS => api_versions(&mut answer, version),
            METADATA => metadata(&mut answer, &request, port, state)?,
            _ => return None,
        }
        stream.write_all(&i32::try_from(answer.len()).ok()?.to_be_bytes()).ok()?;
        stream.write_all(&answer).ok()?;
    }
}

fn put(answer: &mut Vec<u8>, text: &str) {
    answer.extend(i16::try_from(text.len()).unwrap().to_be_bytes());
    answer.extend(text.as_bytes());
}

fn api_versions(answer: &mut Vec<u8>, version: i16) {
    let error = if version == 0 { 0 } else { UNSUPPORTED_VERSION };
    answer.extend(error.to_be_bytes());
    answer.extend(2_i32.to_be_bytes());
    for (key, most) in [(METADATA, 1_i16), (API_VERSIONS, 0)] {
        answer.extend(key.to_be_bytes());
        answer.extend(0_i16.to_be_bytes());
        answer.extend(most.to_be_bytes());
    }
}

/// Version 1, of the topics that are asked for; of none if all are.
fn metadata(answer: &mut Vec<u8>, request: &[u8], port: u16, state: &State) -> Option<()> {
    let lost = state.lost.load(Ordering::SeqCst);
    let client = usize::try_from(i16::from_be_bytes(request.get(8..10)?.try_into().ok()?)).ok()?;
    let mut rest = request.get(10 + client..)?;
    let mut take = |count: usize| {
        let (taken, left) = rest.split_at_checked(count)?;
        rest = left;
        Some(taken)
    };
    let count = i32::from_be_bytes(take(4)?.try_into().ok()?).max(0);
    let mut topics = Vec::new();
    for _ in 0..count {
        let length = usize::try_from(i16::from_be_bytes(take(2)?.try_into().ok()?)).ok()?;
        topics.push(String::from_utf8(take(length)?.to_vec()).ok()?);
    }
    answer.extend(i32::from(!lost).to_be_bytes());
    if !lost {
        answer.extend(BROKER.to_be_bytes());
        put(answer, "127.0.0.1");
        answer.extend(i32::from(port).to_be_bytes());
        answer.extend((-1_i16).to_be_bytes());
    }
    answer.extend((if lost { -1 } else { BROKER }).to_be_bytes());
    answer.extend(count.to_be_bytes());
    for topic in &topics {
        answer.extend((if lost { LEADER_NOT_AVAILABLE } else { 0 }).to_be_bytes());
        put(answer, topic);
        answer.push(0);
        answer.extend(1_i32.to_be_bytes());
        answer.extend((if lost { LEADER_NOT_AVAILABLE } else { 0 }).to_be_bytes());
        answer.extend(0_i32.to_be_bytes());
        answer.extend((if lost { -1 } else { BROKER }).to_be_bytes());
        for _ in 0..2 {
            answer.extend(1_i32.to_be_bytes());
            answer.extend(BROKER.to_be_bytes());
        }
    }
    if lost {
        state.lost_answers.fetch_add(1, Ordering::SeqCst);
    }
    Some(())
}
