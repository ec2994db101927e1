//! A registration as it goes on.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use anyhow::Result;
use upcr::{PointCloud, PoseStep, Registration, Rigid, Settings};

use super::Stream;

/// A registration as it is streamed: the source moves from pose to pose, the first guess at `iteration` 0, the answer at the
/// last.
pub struct Shown {
    stream: Stream,
    iteration: AtomicU64,
    stage: Mutex<String>,
}

impl Shown {
    pub fn new(mut stream: Stream, source: &PointCloud, target: &PointCloud, settings: &Settings) -> Self {
        stream.cloud("target", target, 1);
        stream.cloud("source", source, 0);
        stream.pose("target", &Rigid::identity());
        stream.at("iteration", 0);
        stream.pose("source", &settings.init.unwrap_or_else(Rigid::identity));
        Self { stream, iteration: AtomicU64::new(0), stage: Mutex::default() }
    }

    pub fn stage(&self, now: String) {
        let mut stage = self.stage.lock().unwrap_or_else(PoisonError::into_inner);
        if *stage != now {
            self.stream.say(&now);
            *stage = now;
        }
    }

    pub fn step(&self, step: &PoseStep) {
        self.move_source(&step.T_target_source);
        if step.iteration == 0 {
            self.stream.say(&format!("hypothesis {} is refined", step.hypothesis + 1));
        }
        if let Some(pairs) = step.pairs {
            let level = if step.fine { "fine" } else { "coarse" };
            self.stream.number(&format!("rmse/{level}"), pairs.rmse);
            self.stream.number(&format!("paired/{level}"), pairs.share);
        }
    }

    fn move_source(&self, T_target_source: &Rigid) {
        let iteration = self.iteration.fetch_add(1, Ordering::Relaxed) + 1;
        self.stream.at("iteration", iteration);
        self.stream.pose("source", T_target_source);
    }

    pub fn end(self, found: &Registration, summary: &str) -> Result<()> {
        self.move_source(&found.T_target_source);
        self.stream.say(if found.is_trustworthy() { "registered" } else { "not registered" });
        for reason in &found.reasons {
            self.stream.say(&format!("caveat: {reason}"));
        }
        self.stream.number("verdict/probability", found.probability);
        self.stream.number("verdict/fitness", found.fitness);
        self.stream.number("rmse/answer", found.inlier_rmse);
        self.stream.document("summary", summary);
        self.stream.close()
    }
}
