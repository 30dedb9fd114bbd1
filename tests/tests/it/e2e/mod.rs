//! End-to-end tests: real `blaze demo --only …` processes over loopback and between network namespaces.
//!
//! They measure time and rates on a machine of two cores, so they run one after another. Each has DDS domains of its
//! own. `BLAZE_LONG` selects the full counts.

mod drain;
mod edge_to_edge;
mod lossy_link;
mod meeting;
mod pace;
mod restarts;
mod support;
