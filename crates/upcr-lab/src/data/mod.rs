//! Where the lab's clouds come from: registration protocols over shapes, and a virtual scanner.

pub mod pairs;
pub mod scanner;
