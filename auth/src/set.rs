//! The keys that are accepted at one time.

use crate::{Refusal, VerifyKey};

/// Keys with their ids. Where two have one id, the one that was added first holds.
#[derive(Debug, Clone, Default)]
pub struct KeySet {
    keys: Vec<(Option<String>, VerifyKey)>,
}

impl KeySet {
    /// No keys: nothing is accepted.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// One more key; `false` if its id is taken.
    pub fn add(&mut self, id: Option<String>, key: VerifyKey) -> bool {
        let free = id.is_none() || self.keys.iter().all(|(taken, _)| *taken != id);
        if free {
            self.keys.push((id, key));
        }
        free
    }

    /// How many there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.keys.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.keys.is_empty()
    }

    /// The key of a `kid`. Without one there must be no choice.
    pub(crate) fn find(&self, kid: Option<&str>) -> Result<&VerifyKey, Refusal> {
        match (kid, self.keys.as_slice()) {
            (Some(kid), keys) => {
                let found = keys.iter().find(|(id, _)| id.as_deref() == Some(kid));
                found.map(|(_, key)| key).ok_or_else(|| Refusal::UnknownKey(kid.to_owned()))
            }
            (None, [(_, key)]) => Ok(key),
            (None, []) => Err(Refusal::Invalid("there is no key to check tokens with".to_owned())),
            (None, keys) => {
                let count = keys.len();
                Err(Refusal::Invalid(format!("the token has no kid, and there are {count} keys")))
            }
        }
    }
}
