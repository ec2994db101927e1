//! What may end a registration before its time, and who hears how far it is.

use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use serde::Serialize;
use web_time::Instant;

use crate::{Error, registration::Reason, settings::Method, transform::Rigid};

/// A step of a registration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Stage {
    /// Checks, scale, downsampling, normals.
    Prepare,
    /// Features, matching, hypotheses.
    Hypotheses,
    /// Refinement.
    Refine,
    /// Scoring and verdict.
    Verify,
}

impl std::fmt::Display for Stage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Prepare => "preparing",
            Self::Hypotheses => "looking for poses",
            Self::Refine => "refining",
            Self::Verify => "verifying",
        })
    }
}

/// How far a registration is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[non_exhaustive]
pub struct Progress {
    /// The step under way.
    pub stage: Stage,
    /// The source of hypotheses that it works for; none while the clouds are prepared.
    pub method: Option<Method>,
    /// Share of the longest way that the registration may take, 0 to 1. It never falls, jumps where a source suffices,
    /// and is 1 once, at the end.
    pub done: f64,
}

/// A pose that the refinement goes through.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct PoseStep {
    /// The source of hypotheses that proposed the one which is refined.
    pub method: Method,
    /// The number of that hypothesis, among all that the call refines to the end, from 0.
    pub hypothesis: usize,
    /// Iterations since the hypothesis: 0 is the hypothesis itself.
    pub iteration: usize,
    /// Whether it comes of the fine refinement, whose iterations [`Registration::iterations`](crate::Registration) counts.
    pub fine: bool,
    /// Takes source coordinates to target coordinates, in the clouds' own frames.
    pub T_target_source: Rigid,
    /// The pairs of points that the iteration laid on each other; none for the hypothesis itself.
    pub pairs: Option<StepPairs>,
}

/// What an iteration of the refinement worked on.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct StepPairs {
    /// Share of the points it moved that have a partner within reach. The reach shrinks from iteration to iteration.
    pub share: f64,
    /// Root of the mean square distance of these pairs at the new pose, in the clouds' unit.
    pub rmse: f64,
}

/// How a registration is watched from outside; the default is not at all.
#[derive(Clone, Copy, Default)]
pub struct Watch<'a> {
    /// Whether the caller has lost interest: the call then ends soon, with the best pose so far. Asked often, by several
    /// threads at once, and no more once it said yes; what it does should cost no more than to look at a flag.
    pub cancelled: Option<&'a (dyn Fn() -> bool + Sync)>,
    /// Hears how far the call is: some tens of times, never twice at once, in order, on whatever thread the call runs.
    /// The call waits meanwhile.
    pub progress: Option<&'a (dyn Fn(Progress) + Sync)>,
    /// Hears each pose that the refinement goes through, of each hypothesis that is refined to the end, one hypothesis after
    /// the other; otherwise as `progress`.
    pub poses: Option<&'a (dyn Fn(PoseStep) + Sync)>,
}

impl std::fmt::Debug for Watch<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Watch")
            .field("cancelled", &self.cancelled.is_some())
            .field("progress", &self.progress.is_some())
            .field("poses", &self.poses.is_some())
            .finish()
    }
}

/// Whether the work under way is to be left undone.
pub(crate) type IsOver<'a> = &'a (dyn Fn() -> bool + Sync);

/// Why a step gave nothing.
#[derive(Debug)]
pub(crate) enum Stop {
    /// It failed.
    Failed(Error),
    /// The call is over.
    Over,
    /// It takes more memory than it may.
    Full,
}

impl From<Error> for Stop {
    fn from(error: Error) -> Self {
        Self::Failed(error)
    }
}

/// A registration under way: what ends it early, and how far it is.
pub(crate) struct Call<'a> {
    deadline: Option<Instant>,
    watch: Watch<'a>,
    /// What has ended it: one of the constants below.
    ended: AtomicU8,
    step: Mutex<Step>,
}

const NOT_ENDED: u8 = 0;
const BY_TIME: u8 = 1;
const BY_CALLER: u8 = 2;

/// The step under way and its part of the whole.
#[derive(Clone, Copy)]
struct Step {
    stage: Stage,
    method: Option<Method>,
    from: f64,
    to: f64,
    done: f64,
}

impl<'a> Call<'a> {
    /// Begins now, and has so many seconds.
    pub fn new(max_seconds: Option<f64>, watch: Watch<'a>) -> Self {
        // A limit beyond what the clock can tell is none.
        let after = |seconds| Instant::now().checked_add(Duration::try_from_secs_f64(seconds).ok()?);
        let step = Step { stage: Stage::Prepare, method: None, from: 0.0, to: 1.0, done: 0.0 };
        Self {
            deadline: max_seconds.and_then(after),
            watch,
            ended: AtomicU8::new(NOT_ENDED),
            step: Mutex::new(step),
        }
    }

    /// For a question beside the work, which has the same limits and tells nothing.
    pub fn aside(&self) -> Call<'a> {
        let watch = Watch { progress: None, poses: None, ..self.watch };
        Self { deadline: self.deadline, ..Self::new(None, watch) }
    }

    /// Whether the work still to be done is to be left undone. Asked where there is some: yes once is yes for good, and
    /// a reason against the result.
    pub fn is_over(&self) -> bool {
        if self.ended.load(Ordering::Relaxed) != NOT_ENDED {
            return true;
        }
        let by = if self.watch.cancelled.is_some_and(|cancelled| cancelled()) {
            BY_CALLER
        } else if self.deadline.is_some_and(|deadline| Instant::now() >= deadline) {
            BY_TIME
        } else {
            return false;
        };
        // Threads may see different causes: the first counts.
        let _ = self.ended.compare_exchange(NOT_ENDED, by, Ordering::Relaxed, Ordering::Relaxed);
        true
    }

    /// [`Stop::Over`] where the call [is over](Self::is_over).
    pub fn go_on(&self) -> Result<(), Stop> {
        if self.is_over() { Err(Stop::Over) } else { Ok(()) }
    }

    /// What has ended the call, where some of its work was left undone.
    pub fn ended_by(&self) -> Option<Reason> {
        match self.ended.load(Ordering::Relaxed) {
            NOT_ENDED => None,
            BY_TIME => Some(Reason::TimeLimit),
            _ => Some(Reason::Cancelled),
        }
    }

    /// Tells that a step begins, which leads from one share of the whole to another.
    pub fn begin(&self, stage: Stage, method: Option<Method>, (from, to): (f64, f64)) {
        self.tell(|step| Step { stage, method, from, to, done: step.done.max(from) });
    }

    /// Tells that so much of the step is done, 0 to 1.
    ///
    /// Called, as all that tells, between parallel work and not from it.
    pub fn advance(&self, share: f64) {
        self.tell(|step| Step { done: step.done.max(step.from + share * (step.to - step.from)), ..step });
    }

    /// Whether someone hears the poses.
    pub fn tells_poses(&self) -> bool {
        self.watch.poses.is_some()
    }

    /// Tells a pose that the refinement goes through.
    pub fn tell_pose(&self, step: PoseStep) {
        if let Some(poses) = self.watch.poses {
            poses(step);
        }
    }

    /// Tells that the call has an answer.
    pub fn end(&self) {
        self.tell(|step| Step { done: 1.0, ..step });
    }

    fn tell(&self, next: impl FnOnce(Step) -> Step) {
        let Some(progress) = self.watch.progress else { return };
        let mut step = self.step.lock().unwrap_or_else(PoisonError::into_inner);
        *step = next(*step);
        let Step { stage, method, done, .. } = *step;
        drop(step);
        progress(Progress { stage, method, done });
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicUsize;

    use super::*;

    #[test]
    fn what_ends_a_call_first_has_ended_it() {
        let asked = AtomicUsize::new(0);
        let third = || asked.fetch_add(1, Ordering::Relaxed) == 2;
        let call = Call::new(Some(1e300), Watch { cancelled: Some(&third), ..Watch::default() });
        assert!(!call.is_over() && !call.is_over() && call.ended_by().is_none());
        assert!(call.is_over() && call.is_over());
        assert_eq!((call.ended_by(), asked.load(Ordering::Relaxed)), (Some(Reason::Cancelled), 3));

        let late = Call::new(Some(0.0), Watch::default());
        assert_eq!(late.ended_by(), None, "nothing was left undone yet");
        assert!(matches!(late.go_on(), Err(Stop::Over)));
        assert_eq!(late.ended_by(), Some(Reason::TimeLimit));
        assert!(Call::new(None, Watch::default()).go_on().is_ok());
    }

    #[test]
    fn progress_never_falls() {
        let told = Mutex::new(Vec::new());
        let hear = |p: Progress| told.lock().unwrap().push((p.stage, p.done));
        let call = Call::new(None, Watch { progress: Some(&hear), ..Watch::default() });
        call.begin(Stage::Prepare, None, (0.0, 0.5));
        call.advance(0.5);
        call.begin(Stage::Refine, None, (0.2, 0.4));
        call.begin(Stage::Verify, None, (0.5, 0.75));
        call.end();
        let expected = [
            (Stage::Prepare, 0.0),
            (Stage::Prepare, 0.25),
            (Stage::Refine, 0.25),
            (Stage::Verify, 0.5),
            (Stage::Verify, 1.0),
        ];
        assert_eq!(*told.lock().unwrap(), expected);
    }
}
