//! How much may leave: rates per lane, and the budget of the wire.
//!
//! The allocator of F9 will decide each lane's rate here; today a lane runs at the rate that its requesters ask for and the
//! pacer alone keeps the budget.

pub mod allocate;
pub mod bucket;
pub mod pacer;
pub mod rates;

/// Bits of one megabit in `limit_mbps`: 1024², as in the paper. 160 means 167.8 Mbit/s in SI units.
pub const BITS_PER_MEGABIT: f64 = 1024.0 * 1024.0;

/// The byte budget of a limit: `B_avail = L_client · 1024² / 8`, in bytes per second (F9).
#[must_use]
pub fn budget_bytes_per_s(limit_mbps: f64) -> f64 {
    limit_mbps * BITS_PER_MEGABIT / 8.0
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_budget_is_that_of_the_paper() {
        assert!((super::budget_bytes_per_s(160.0) - 20_971_520.0).abs() < 1e-6);
    }
}
