//! The command line of UPCR.

fn main() {}
