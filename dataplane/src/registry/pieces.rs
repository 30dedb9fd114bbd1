//! Entries cut into pieces that fit a datagram, and the digest.
//!
//! An entry that does not fit one datagram travels as several with the same topic; they are joined
//! when all parts of their Delta or Snapshot are there. The digest is taken over whole entries, so
//! both sides compute the same.

use std::collections::BTreeMap;

use blaze_proto::link::link_control as wire;
use prost::Message;

use crate::plan::rendezvous::stable_hash;

/// Largest encoded LinkControl, in bytes.
pub const MAX_LINK_CONTROL_BYTES: usize = 1200;
/// What remains of it for entries, beside the envelope of a Delta with the largest numbers.
const MAX_PART_BYTES: usize = MAX_LINK_CONTROL_BYTES - 40;
/// Largest piece of an entry: one fits a part with its tag and length.
pub(super) const MAX_PIECE_BYTES: usize = MAX_PART_BYTES - 4;
/// Cuts an entry into pieces that each fit a part; most entries are one piece.
pub(super) fn pieces(entry: wire::Entry) -> Vec<wire::Entry> {
    if entry.encoded_len() <= MAX_PIECE_BYTES {
        return vec![entry];
    }
    let mut pieces: Vec<wire::Entry> = Vec::new();
    for atom in atoms(&entry) {
        if let Some(last) = pieces.last_mut() {
            let mut joined = last.clone();
            absorb(&mut joined, atom.clone());
            if joined.encoded_len() <= MAX_PIECE_BYTES {
                *last = joined;
                continue;
            }
        }
        pieces.push(atom);
    }
    pieces
}

/// The smallest parts of an entry that [`absorb`] joins again, in order.
fn atoms(entry: &wire::Entry) -> Vec<wire::Entry> {
    let with = |fill: &dyn Fn(&mut wire::Entry)| {
        let mut atom = wire::Entry { topic: entry.topic.clone(), ..wire::Entry::default() };
        fill(&mut atom);
        atom
    };
    let mut atoms = vec![
        with(&|atom| atom.node_advertise.clone_from(&entry.node_advertise)),
        with(&|atom| atom.layer_advertise.clone_from(&entry.layer_advertise)),
        with(&|atom| atom.outside_advertise.clone_from(&entry.outside_advertise)),
        with(&|atom| atom.ros2_advertise.clone_from(&entry.ros2_advertise)),
    ];
    let mut request = |request: Option<&wire::Request>,
                       place: fn(&mut wire::Entry, wire::Request)| {
        let Some(mut request) = request.cloned() else { return };
        let filters = std::mem::take(&mut request.from);
        atoms.push(with(&|atom| place(atom, request.clone())));
        atoms.extend(filters.into_iter().map(|filter| {
            let more = wire::Request { from: vec![filter], ..wire::Request::default() };
            with(&|atom| place(atom, more.clone()))
        }));
    };
    request(entry.node_request.as_ref(), |atom, request| {
        atom.node_request = Some(request);
    });
    request(entry.layer_request.as_ref(), |atom, request| {
        atom.layer_request = Some(request);
    });
    request(entry.outside_request.as_ref(), |atom, request| {
        atom.outside_request = Some(request);
    });
    request(entry.ros2_request.as_ref(), |atom, request| {
        atom.ros2_request = Some(request);
    });
    let route = |route: &wire::RouteState| with(&|atom| atom.route_state.push(route.clone()));
    atoms.extend(entry.route_state.iter().map(route));
    atoms
}

/// Adds a piece to the pieces before it. The first piece of a request holds all but its further
/// filters.
fn absorb(into: &mut wire::Entry, piece: wire::Entry) {
    fn request(into: &mut Option<wire::Request>, piece: Option<wire::Request>) {
        match (into, piece) {
            (Some(into), Some(piece)) => into.from.extend(piece.from),
            (into @ None, piece) => *into = piece,
            (Some(_), None) => {}
        }
    }
    into.removed |= piece.removed;
    into.node_advertise = into.node_advertise.take().or(piece.node_advertise);
    into.layer_advertise = into.layer_advertise.take().or(piece.layer_advertise);
    request(&mut into.node_request, piece.node_request);
    request(&mut into.layer_request, piece.layer_request);
    into.outside_advertise = into.outside_advertise.take().or(piece.outside_advertise);
    request(&mut into.outside_request, piece.outside_request);
    into.ros2_advertise = into.ros2_advertise.take().or(piece.ros2_advertise);
    request(&mut into.ros2_request, piece.ros2_request);
    into.route_state.extend(piece.route_state);
}

/// Joins the pieces of a complete Delta or Snapshot to one entry per topic.
pub(super) fn join(pieces: impl IntoIterator<Item = wire::Entry>) -> BTreeMap<String, wire::Entry> {
    let mut entries: BTreeMap<String, wire::Entry> = BTreeMap::new();
    for piece in pieces {
        match entries.get_mut(&piece.topic) {
            Some(entry) => absorb(entry, piece),
            None => {
                entries.insert(piece.topic.clone(), piece);
            }
        }
    }
    entries
}

/// Spreads pieces over parts that each fit a LinkControl; at least one part, which may be empty.
pub(super) fn pack(pieces: impl IntoIterator<Item = wire::Entry>) -> Vec<Vec<wire::Entry>> {
    let mut parts: Vec<Vec<wire::Entry>> = vec![Vec::new()];
    let mut used = 0;
    for piece in pieces {
        let length = piece.encoded_len();
        let length = 1 + prost::length_delimiter_len(length) + length;
        if used + length > MAX_PART_BYTES && used > 0 {
            parts.push(Vec::new());
            used = 0;
        }
        used += length;
        if let Some(part) = parts.last_mut() {
            part.push(piece);
        }
    }
    parts
}

/// Hash of one whole entry. The digest of a flow is the wrapping sum over its entries, so their
/// order does not matter.
pub(crate) fn entry_hash(entry: &wire::Entry) -> u64 {
    let mut entry = entry.clone();
    let requests = [&mut entry.node_request, &mut entry.layer_request, &mut entry.outside_request];
    for request in requests.into_iter().flatten() {
        // Flows of earlier versions do not know these.
        request.services.clear();
        (request.more_services, request.json, request.unframed) = (0, false, false);
    }
    (entry.ros2_advertise, entry.ros2_request) = (None, None);
    text_hash(&entry.encode_to_vec())
}

/// A hash that is the same in every flow.
pub(super) fn text_hash(bytes: &[u8]) -> u64 {
    stable_hash(bytes.iter().copied())
}
