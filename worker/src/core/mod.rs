//! What the worker knows and what follows from it. No I/O and no clock: everything comes in as an argument.
