//! Inputs at random, changed from good ones, for as long as one likes: `BLAZE_FUZZ_SECONDS` for
//! each of the four. An input that fails is printed.

#[allow(dead_code, reason = "made for the data plane, which uses the rest")]
#[path = "../../../dataplane/src/testing/random.rs"]
mod random;

mod long {
    use std::panic::{AssertUnwindSafe, catch_unwind};
    use std::time::{Duration, Instant};

    use super::super::properties::programs;
    use super::super::values::{Entropy, cdr};
    use super::super::*;
    use super::random::Random;
    use crate::{Distro, built_in, definition_text, parse_action, parse_joined, parse_service};

    /// Longest time of one input. The largest are far below it.
    const SLOW: Duration = Duration::from_secs(5);
    /// Pieces that are put into inputs.
    const WORDS: &[&[u8]] = &[
        b"\"",
        b"{",
        b"}",
        b"[",
        b"]",
        b",",
        b":",
        b"null",
        b"1e999",
        b"-0",
        b"\\ud800",
        b"\\u0000",
        b"18446744073709551616",
        b"\xff\xff\xff\xff",
        b"\0\0\0\0",
        b"\0\0\0\x80",
        b"\xf0\x9f\x98\x80",
        b"[4294967295]",
        b"[<=3]",
        b"string<=",
        b"wstring ",
        b"\n===\nMSG: ",
        b"---\n",
        b"#",
        b"=",
        b"/",
    ];

    fn seconds() -> u64 {
        let given = std::env::var_os("BLAZE_FUZZ_SECONDS");
        given.and_then(|text| text.to_str()?.parse().ok()).unwrap_or(10)
    }

    fn changed(random: &mut Random, good: &[u8]) -> Vec<u8> {
        let mut data = good.to_vec();
        for _ in 0..=random.index(6) {
            let at = random.index(data.len() + 1);
            let end = (at + random.index(9)).min(data.len());
            match random.index(5) {
                0 => data.splice(at..end, []).count(),
                1 => data.splice(at..at, random.pick(WORDS).iter().copied()).count(),
                2 => data.splice(at..end, random.pick(WORDS).iter().copied()).count(),
                3 => {
                    let from = random.index(good.len() + 1);
                    let until = (from + random.index(200)).min(good.len());
                    data.splice(at..at, good[from..until].iter().copied()).count()
                }
                _ => data
                    .get_mut(at)
                    .map_or(0, |byte| usize::from(std::mem::replace(byte, random.byte()))),
            };
        }
        data
    }

    /// Gives changed inputs to `run`, each with the number of the good one.
    fn fuzz(good: &[Vec<u8>], run: impl Fn(usize, &[u8])) {
        let mut random = Random(20_261_128);
        let begin = Instant::now();
        let mut count = 0u64;
        while begin.elapsed() < Duration::from_secs(seconds()) {
            let which = random.index(good.len());
            let input = changed(&mut random, &good[which]);
            let start = Instant::now();
            let done = catch_unwind(AssertUnwindSafe(|| run(which, &input)));
            assert!(done.is_ok(), "input {count} panics: {}", input.escape_ascii());
            assert!(start.elapsed() < SLOW, "input {count} is slow: {}", input.escape_ascii());
            count += 1;
        }
        println!("{count} inputs in {} s", begin.elapsed().as_secs());
    }

    /// Each type with a few values.
    fn messages() -> (Vec<Program>, Vec<Vec<u8>>) {
        let mut random = Random(7);
        let all = programs().into_iter().flat_map(|(_, program)| vec![program; 4]);
        all.map(|program| {
            let bytes = cdr(&program, &mut Entropy(&random.bytes(2_000)));
            (program, bytes)
        })
        .unzip()
    }

    #[test]
    fn cdr_to_json() {
        let (programs, good) = messages();
        fuzz(&good, |which, input| {
            let mut out = Vec::new();
            if programs[which].to_json(input, &mut out).is_ok() {
                assert!(serde_json::from_slice::<serde_json::Value>(&out).is_ok());
            }
        });
    }

    #[test]
    fn json_to_cdr() {
        let (programs, messages) = messages();
        let texts = programs.iter().zip(&messages).map(|(program, message)| {
            let mut text = Vec::new();
            program.to_json(message, &mut text).expect("a good message");
            text
        });
        let good: Vec<Vec<u8>> = texts.collect();
        fuzz(&good, |which, input| {
            let (mut out, mut text, mut again) = (Vec::new(), Vec::new(), Vec::new());
            if programs[which].to_cdr(input, &mut out).is_ok() {
                programs[which].to_json(&out, &mut text).expect("our own CDR");
                programs[which].to_cdr(&text, &mut again).expect("our own JSON");
                assert_eq!(out, again);
            }
        });
    }

    /// Converts a message of zeros, if the type can be compiled.
    fn compiled(description: &TypeDescription) {
        if let Ok(program) = Program::compile(description) {
            let (mut out, mut text) = (Vec::new(), Vec::new());
            if program.to_cdr(b"{}", &mut out).is_ok() {
                let _ = program.to_json(&out, &mut text);
            }
        }
    }

    #[test]
    fn definition_texts() {
        let types = built_in(Distro::Jazzy);
        let good: Vec<Vec<u8>> = types
            .names()
            .map(|name| {
                definition_text(&types.describe(name).expect("it is built in")).into_bytes()
            })
            .collect();
        fuzz(&good, |_, input| {
            let text = String::from_utf8_lossy(input);
            if let Ok(description) = parse_joined("a/msg/Test", &text, Some(&types)) {
                let written = definition_text(&description);
                compiled(&description);
                let again = parse_joined("a/msg/Test", &written, None).expect("our own text");
                assert_eq!(description.hash(), again.hash());
            }
            let _ = parse_service("a/srv/Test", &text);
            let _ = parse_action("a/action/Test", &text);
        });
    }

    #[test]
    fn type_descriptions() {
        let types = built_in(Distro::Jazzy);
        let good: Vec<Vec<u8>> = types
            .names()
            .map(|name| types.describe(name).expect("it is built in"))
            .map(|description| serde_json::to_vec(&description).expect("JSON"))
            .collect();
        fuzz(&good, |_, input| {
            if let Ok(description) = TypeDescription::from_json(input) {
                compiled(&description);
                let _ = (description.hash(), definition_text(&description));
            }
        });
    }
}
