//! Many scans: poses of pairs to poses of all.

mod block_cholesky;
mod pose_graph;

pub use pose_graph::{Edge, Judged, PoseGraph, Solution};
