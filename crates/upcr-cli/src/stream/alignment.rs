//! Many scans as they come together.

use std::sync::atomic::{AtomicU64, Ordering};

use anyhow::Result;
use upcr::Rigid;
use upcr::multiway::{Attempt, Scans};
use upcr_report::MOST_POINTS;

use super::Stream;

/// A merge as it is streamed: all scans move from `step` to `step` of every alignment.
pub struct Alignment<'a> {
    stream: Stream,
    names: &'a [String],
    step: AtomicU64,
}

impl<'a> Alignment<'a> {
    /// Shows the scans as they lie, thinned so that all of them together are as many points as one cloud may have.
    pub fn new(mut stream: Stream, scans: &impl Scans, names: &'a [String]) -> Self {
        let most = (MOST_POINTS / scans.len().max(1)).max(1);
        for (scan, name) in names.iter().enumerate() {
            // What cannot be read is told by the merge.
            let Ok(cloud) = scans.read(scan) else { continue };
            let some: Vec<usize> = (0..cloud.len()).step_by(cloud.len().div_ceil(most).max(1)).collect();
            stream.cloud(name, &cloud.select(&some), scan);
        }
        let shown = Self { stream, names, step: AtomicU64::new(0) };
        shown.poses(&vec![Rigid::identity(); names.len()]);
        shown
    }

    pub fn pair(&self, attempt: &Attempt) {
        let [source, target] = [attempt.source, attempt.target].map(|scan| &self.names[scan]);
        self.stream.say(&format!("{source} -> {target}: probability {:.3}", attempt.probability));
        self.stream.number("pairs/probability", attempt.probability);
    }

    pub fn poses(&self, poses: &[Rigid]) {
        self.stream.at("step", self.step.fetch_add(1, Ordering::Relaxed));
        for (name, pose) in self.names.iter().zip(poses) {
            self.stream.pose(name, pose);
        }
    }

    pub fn end(self, summary: &str) -> Result<()> {
        self.stream.document("summary", summary);
        self.stream.close()
    }
}
