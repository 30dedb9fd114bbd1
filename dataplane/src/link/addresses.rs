//! Where flows can be found: own addresses, and those that peers told.

use std::collections::VecDeque;

/// Addresses in one Hello.
const PER_HELLO: usize = 16;
/// Learnt addresses that are kept.
const KEPT: usize = 256;
/// Longest address, in bytes.
const LONGEST: usize = 64;
/// Bytes of addresses in one Hello.
const HELLO_BYTES: usize = 512;

#[derive(Debug, Default)]
pub(crate) struct Addresses {
    own: Vec<String>,
    learnt: VecDeque<String>,
}

impl Addresses {
    pub(crate) fn set_own(&mut self, mut own: Vec<String>) {
        own.retain(|address| is_plausible(address));
        own.truncate(PER_HELLO);
        self.learnt.retain(|address| !own.contains(address));
        self.own = own;
    }

    /// Takes what a peer told. Returns what is new.
    pub(crate) fn learn(&mut self, told: &[String]) -> Vec<String> {
        let mut new = Vec::new();
        for address in told.iter().take(PER_HELLO).filter(|address| is_plausible(address)) {
            if self.own.contains(address) || self.learnt.contains(address) {
                continue;
            }
            if self.learnt.len() >= KEPT {
                self.learnt.pop_front();
            }
            self.learnt.push_back(address.clone());
            new.push(address.clone());
        }
        new
    }

    /// Addresses for the next Hello: the own ones, then some of the others in turn.
    pub(crate) fn for_hello(&mut self) -> Vec<String> {
        let mut addresses: Vec<String> = Vec::new();
        let mut bytes = 0;
        let others = self.learnt.iter().take(PER_HELLO);
        for address in self.own.iter().chain(others) {
            bytes += address.len() + 2;
            if addresses.len() >= PER_HELLO || bytes > HELLO_BYTES {
                break;
            }
            addresses.push(address.clone());
        }
        let told = addresses.len().saturating_sub(self.own.len()).min(self.learnt.len());
        self.learnt.rotate_left(told);
        addresses
    }
}

fn is_plausible(address: &str) -> bool {
    !address.is_empty() && address.len() <= LONGEST && address.chars().all(|c| c.is_ascii_graphic())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_address_gets_its_turn() {
        let mut addresses = Addresses::default();
        addresses.set_own(vec!["10.0.0.1".into()]);
        let told: Vec<Vec<String>> =
            (0..3).map(|batch| (0..15).map(|at| format!("10.1.{batch}.{at}")).collect()).collect();
        for batch in &told {
            assert_eq!(addresses.learn(batch).len(), 15);
            assert!(addresses.learn(batch).is_empty(), "known by now");
        }
        let mut seen = std::collections::BTreeSet::new();
        for _ in 0..3 {
            let hello = addresses.for_hello();
            assert_eq!((hello.len(), hello[0].as_str()), (16, "10.0.0.1"));
            seen.extend(hello);
        }
        assert_eq!(seen.len(), 46);
        assert!(addresses.learn(&["x".repeat(65), String::new(), "a b".into()]).is_empty());
    }
}
