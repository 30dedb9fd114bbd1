//! How far services were told, as the leading worker leaves it beside the lease.

use serde::{Deserialize, Serialize};

/// A state of a main service's store.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Mark {
    /// Which store.
    pub store_id: String,
    /// Revision of its last commit that counts.
    pub revision: u64,
}

impl Mark {
    /// Whether whatever follows from `other` follows from this, too. Of two stores neither says
    /// anything about the other.
    #[must_use]
    pub fn covers(&self, other: &Self) -> bool {
        self.store_id == other.store_id && self.revision >= other.revision
    }

    /// As it lies beside the lease.
    #[must_use]
    pub fn to_text(&self) -> String {
        serde_json::json!({ "store_id": self.store_id, "revision": self.revision }).to_string()
    }

    /// `None`: it is no mark, so nothing is known.
    #[must_use]
    pub fn parse(text: &str) -> Option<Self> {
        serde_json::from_str(text).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mark(store: &str, revision: u64) -> Mark {
        Mark { store_id: store.to_owned(), revision }
    }

    #[test]
    fn of_one_store_the_later_covers_the_earlier_and_two_stores_nothing() {
        assert!(mark("a", 5).covers(&mark("a", 5)) && mark("a", 6).covers(&mark("a", 5)));
        assert!(!mark("a", 4).covers(&mark("a", 5)) && !mark("b", 9).covers(&mark("a", 5)));
    }

    #[test]
    fn it_is_read_as_it_was_written_and_anything_else_is_no_mark() {
        let one = mark("0197-\"x\"", u64::MAX);
        assert_eq!(Mark::parse(&one.to_text()), Some(one));
        for text in ["", "7", "{}", "{\"store_id\":\"a\"}", "{\"store_id\":\"a\",\"revision\":-1}"]
        {
            assert_eq!(Mark::parse(text), None, "{text}");
        }
    }
}
