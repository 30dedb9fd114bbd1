//! A document as a register: what may be done with it, and what each answer says of its state.

/// What was written, unique among all writes to one register.
pub(crate) type Content = u32;

/// Something that a client asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Op {
    /// Make it; refused if it is there.
    Create(Content),
    /// Look.
    Get,
    /// Replace it if it is still what the client has seen.
    Swap { seen: Content, new: Content },
    /// Remove it if it is still what the client has seen, or whatever it is.
    Delete { seen: Option<Content> },
}

/// What came back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Outcome {
    /// It took effect.
    Done,
    /// What a look found.
    Found(Option<Content>),
    /// The precondition did not hold.
    Refused,
    /// Nobody knows; it may also take effect later, or never.
    Unknown,
}

/// One operation, with the time of one clock at which it began and was answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Event {
    pub(crate) op: Op,
    pub(crate) outcome: Outcome,
    pub(crate) begin: u64,
    /// [`u64::MAX`] if the outcome is unknown.
    pub(crate) end: u64,
}

impl Event {
    /// The state after this operation took effect on `state`; `None` when this answer would be
    /// wrong there.
    pub(crate) fn on(&self, state: Option<Content>) -> Option<Option<Content>> {
        let (fits, after) = match self.op {
            Op::Create(new) => (state.is_none(), Some(new)),
            Op::Swap { seen, new } => (state == Some(seen), Some(new)),
            Op::Delete { seen: Some(seen) } => (state == Some(seen), None),
            Op::Delete { seen: None } => (state.is_some(), None),
            Op::Get => match self.outcome {
                Outcome::Found(found) => return (found == state).then_some(state),
                Outcome::Done | Outcome::Refused | Outcome::Unknown => return None,
            },
        };
        match self.outcome {
            Outcome::Done | Outcome::Unknown => fits.then_some(after),
            Outcome::Refused => (!fits).then_some(state),
            Outcome::Found(_) => None,
        }
    }
}
