//! Batches of pairs, made ahead of their use by threads of their own.
//!
//! What a batch holds depends on the plan and the batch's position alone, not on threads nor on where the loader
//! started: a run that is resumed sees what it would have seen.

use std::panic::resume_unwind;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{Builder, JoinHandle};

use rand::Rng;
use rand::seq::SliceRandom;
use upcr::{Error, Result, Rigid};

use super::Shapes;
use super::pairs::{Mixture, Pair, Protocol};
use crate::random;

/// Finished batches that wait, for each thread.
const AHEAD: usize = 2;
/// Stream of an epoch's order; the streams of its items are numbered from 0.
const ORDER: u64 = u64::MAX;

/// Which pairs come, and in which order.
#[derive(Debug, Clone)]
pub enum Plan {
    /// Shuffled epochs without end. Shapes that do not fill a batch at an epoch's end are left out, but for a set
    /// smaller than one batch, which is that batch.
    Training(Training),
    /// The protocol's own pair of every shape, in order, once. The last batch may be smaller.
    Evaluation(Protocol),
}

/// How pairs for training are drawn.
#[derive(Debug, Clone)]
pub struct Training {
    /// Protocols and how often each is taken, relative to the others; each pair draws its own.
    pub mixture: Mixture,
    /// Points of every cloud, instead of what the protocols say; partial clouds are cut from larger ones.
    pub points: usize,
    /// Whether a shape's pair changes from epoch to epoch.
    pub poses: Poses,
    /// Seed of the run.
    pub seed: u64,
    /// Where to start.
    pub from: Position,
}

/// Whether a shape's pair changes from epoch to epoch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Poses {
    /// New points, poses and noise in every epoch.
    #[default]
    Fresh,
    /// The protocol's own pair of the shape in every epoch, as evaluations have it.
    Fixed,
}

/// A batch's place in a run. A `batch` beyond the epoch's end is one of later epochs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Position {
    /// Passes over the shapes, from 0.
    pub epoch: u64,
    /// Batches of the epoch, from 0.
    pub batch: u64,
}

/// A pair as it is handed to `prepare`.
#[derive(Debug, Clone, PartialEq)]
pub struct Example {
    /// Index of its shape.
    pub item: usize,
    /// The cloud that is to be moved.
    pub source: Vec<[f32; 3]>,
    /// The cloud it is to be laid on.
    pub target: Vec<[f32; 3]>,
    /// The true motion.
    pub T_target_source: Rigid,
}

/// Pairs side by side: entry i of each list belongs to pair i. All clouds have the same number of points.
#[derive(Debug, Clone, PartialEq)]
pub struct PairBatch<T> {
    /// Its place in the run.
    pub at: Position,
    /// Indices of the shapes.
    pub items: Vec<usize>,
    /// The clouds that are to be moved.
    pub source: Vec<Vec<[f32; 3]>>,
    /// The clouds they are to be laid on.
    pub target: Vec<Vec<[f32; 3]>>,
    /// The true motions.
    pub T_target_source: Vec<Rigid>,
    /// What `prepare` made of each pair.
    pub prepared: Vec<T>,
}

/// An iterator over batches; dropping it ends its threads.
///
/// Thread k of n makes every n-th batch from the k-th on and hands them over through a channel of its own: taken in
/// turn they are in order.
#[derive(Debug)]
pub struct Loader<T> {
    channels: Vec<Receiver<Result<PairBatch<T>>>>,
    threads: Vec<JoinHandle<()>>,
    /// The channel whose turn it is.
    turn: usize,
    batches_per_epoch: u64,
}

impl<T: Send + 'static> Loader<T> {
    /// Starts `threads` threads that make batches of `batch_size` pairs; `prepare`, called in these threads, adds what
    /// the user computes from each pair alone, such as neighbours and features.
    ///
    /// # Errors
    /// Where a setting is out of its range, or a shape has too few points for a protocol.
    pub fn start(
        shapes: &Arc<Shapes>,
        plan: &Plan,
        batch_size: usize,
        threads: usize,
        prepare: impl Fn(&Example) -> Result<T> + Clone + Send + 'static,
    ) -> Result<Self> {
        plan.check(shapes)?;
        for (name, value) in [("batch_size", batch_size), ("threads", threads), ("shapes", shapes.len())] {
            if value == 0 {
                return invalid(name, "must be 1 at least");
            }
        }
        let batches_per_epoch = plan.batches_per_epoch(shapes.len(), batch_size);
        let mut loader = Self { channels: Vec::new(), threads: Vec::new(), turn: 0, batches_per_epoch };
        for first in 0..threads {
            let (sender, receiver) = sync_channel(AHEAD);
            let maker =
                Maker { shapes: shapes.clone(), plan: plan.clone(), batch_size, prepare: prepare.clone() };
            let work = move || maker.run(first, threads, &sender);
            match Builder::new().name(format!("loader {first}")).spawn(work) {
                Ok(thread) => loader.threads.push(thread),
                Err(error) => return invalid("threads", &error.to_string()),
            }
            loader.channels.push(receiver);
        }
        Ok(loader)
    }

    /// Batches that a pass over the shapes takes.
    pub fn batches_per_epoch(&self) -> u64 {
        self.batches_per_epoch
    }
}

impl<T> Iterator for Loader<T> {
    type Item = Result<PairBatch<T>>;

    /// # Panics
    /// With the panic of `prepare`, where it does.
    fn next(&mut self) -> Option<Self::Item> {
        let channel = self.channels.get(self.turn)?;
        if let Ok(batch) = channel.recv() {
            self.turn = (self.turn + 1) % self.channels.len();
            return Some(batch);
        }
        // The thread has ended: with the plan, or in a panic.
        self.channels.clear();
        for thread in self.threads.drain(..) {
            if let Err(panic) = thread.join() {
                resume_unwind(panic);
            }
        }
        None
    }
}

impl<T> Drop for Loader<T> {
    fn drop(&mut self) {
        // Threads end when nobody takes their batches.
        self.channels.clear();
        for thread in self.threads.drain(..) {
            drop(thread.join());
        }
    }
}

impl Plan {
    fn check(&self, shapes: &Shapes) -> Result<()> {
        let fewest = shapes.clouds.iter().map(Vec::len).min().unwrap_or(0);
        match self {
            Self::Evaluation(protocol) => protocol.check(fewest),
            Self::Training(Training { mixture, points, .. }) => {
                let total: f64 = mixture.iter().map(|&(_, weight)| weight).sum();
                if mixture.iter().any(|&(_, weight)| weight < 0.0) || !(total > 0.0 && total.is_finite()) {
                    return invalid("mixture", "needs weights that are not negative and not all zero");
                }
                mixture.iter().try_for_each(|(protocol, _)| protocol.keeping(*points).check(fewest))
            }
        }
    }

    fn batches_per_epoch(&self, shapes: usize, batch_size: usize) -> u64 {
        match self {
            Self::Evaluation(_) => shapes.div_ceil(batch_size) as u64,
            Self::Training(_) => (shapes / batch_size).max(1) as u64,
        }
    }
}

impl Training {
    /// Seed of all that is random in an epoch.
    fn epoch_seed(&self, epoch: u64) -> u64 {
        random::fnv1a(&format!("run {} epoch {epoch}", self.seed))
    }

    fn order(&self, epoch: u64, shapes: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..shapes).collect();
        order.shuffle(&mut random::stream(self.epoch_seed(epoch), ORDER));
        order
    }

    fn pair(&self, epoch: u64, item: usize, shape: &[[f64; 3]]) -> Result<Pair> {
        let rng = &mut random::stream(self.epoch_seed(epoch), item as u64);
        let total: f64 = self.mixture.iter().map(|&(_, weight)| weight).sum();
        let mut left = total * rng.random::<f64>();
        let chosen = self.mixture.iter().find(|&&(_, weight)| {
            left -= weight;
            left < 0.0
        });
        // Rounding may leave none.
        let Some((protocol, _)) = chosen.or(self.mixture.last()) else {
            return invalid("mixture", "is empty");
        };
        let protocol = protocol.keeping(self.points);
        match self.poses {
            Poses::Fresh => protocol.random_pair(shape, rng),
            Poses::Fixed => protocol.pair(shape, item as u64),
        }
    }
}

/// What a thread of the loader has.
struct Maker<F> {
    shapes: Arc<Shapes>,
    plan: Plan,
    batch_size: usize,
    prepare: F,
}

impl<F> Maker<F> {
    /// Makes every `stride`-th batch of the plan from its batch `first` on, until it ends or nobody wants more.
    fn run<T>(&self, first: usize, stride: usize, sender: &SyncSender<Result<PairBatch<T>>>)
    where
        F: Fn(&Example) -> Result<T>,
    {
        let shapes = self.shapes.len();
        let per_epoch = self.plan.batches_per_epoch(shapes, self.batch_size);
        let (start, end) = match &self.plan {
            Plan::Training(training) => {
                let Position { epoch, batch } = training.from;
                (epoch.saturating_mul(per_epoch).saturating_add(batch), u64::MAX)
            }
            Plan::Evaluation(_) => (0, per_epoch),
        };
        let mut order: (Option<u64>, Vec<usize>) = (None, Vec::new());
        for step in (start.saturating_add(first as u64)..end).step_by(stride) {
            let at = Position { epoch: step / per_epoch, batch: step % per_epoch };
            if order.0 != Some(at.epoch) {
                order = (
                    Some(at.epoch),
                    match &self.plan {
                        Plan::Training(training) => training.order(at.epoch, shapes),
                        Plan::Evaluation(_) => (0..shapes).collect(),
                    },
                );
            }
            let from = at.batch as usize * self.batch_size;
            let items = &order.1[from..shapes.min(from + self.batch_size)];
            if sender.send(self.batch(at, items)).is_err() {
                return;
            }
        }
    }

    fn batch<T>(&self, at: Position, items: &[usize]) -> Result<PairBatch<T>>
    where
        F: Fn(&Example) -> Result<T>,
    {
        let mut batch = PairBatch {
            at,
            items: items.to_vec(),
            source: Vec::new(),
            target: Vec::new(),
            T_target_source: Vec::new(),
            prepared: Vec::new(),
        };
        for &item in items {
            let example = self.example(at.epoch, item)?;
            batch.prepared.push((self.prepare)(&example)?);
            batch.source.push(example.source);
            batch.target.push(example.target);
            batch.T_target_source.push(example.T_target_source);
        }
        Ok(batch)
    }

    fn example(&self, epoch: u64, item: usize) -> Result<Example> {
        let shape = self.shapes.points(item);
        let Pair { source, target, T_target_source } = match &self.plan {
            Plan::Training(training) => training.pair(epoch, item, &shape)?,
            Plan::Evaluation(protocol) => protocol.pair(&shape, item as u64)?,
        };
        let single = |cloud: upcr::PointCloud| cloud.points.iter().map(|p| p.map(|v| v as f32)).collect();
        Ok(Example { item, source: single(source), target: single(target), T_target_source })
    }
}

fn invalid<T>(name: &'static str, reason: &str) -> Result<T> {
    Err(Error::InvalidSetting { name, reason: reason.into() })
}

#[cfg(test)]
mod tests {
    use std::panic::{AssertUnwindSafe, catch_unwind};

    use super::*;
    use crate::data::pairs::Coverage;

    fn shapes(count: usize) -> Arc<Shapes> {
        let mut rng = random::stream(3, 0);
        let mut point = || -> [f32; 3] { random::direction(&mut rng).map(|v| v as f32).into() };
        Arc::new(Shapes {
            clouds: (0..count).map(|_| (0..100).map(|_| point()).collect()).collect(),
            labels: vec![0; count],
            names: vec!["sphere".into()],
        })
    }

    fn training(from: Position) -> Plan {
        let mixture = vec![(Protocol::CONSISTENT, 3.0), (Protocol::PARTIAL_INDEPENDENT.noisy(), 1.0)];
        Plan::Training(Training { mixture, points: 40, poses: Poses::Fresh, seed: 7, from })
    }

    fn take(shapes: &Arc<Shapes>, plan: &Plan, threads: usize, count: usize) -> Vec<PairBatch<[f32; 3]>> {
        let prepare = |example: &Example| Ok(example.target[0]);
        let loader = Loader::start(shapes, plan, 4, threads, prepare).unwrap();
        loader.take(count).collect::<Result<_>>().unwrap()
    }

    #[test]
    fn batches_depend_on_their_place_alone() {
        let shapes = shapes(14);
        let all = take(&shapes, &training(Position::default()), 1, 12);
        assert_eq!(all, take(&shapes, &training(Position::default()), 3, 12));
        assert_eq!(all[5..], take(&shapes, &training(Position { epoch: 1, batch: 2 }), 2, 7));
        // The batch after an epoch's last is the next one's first.
        assert_eq!(all[6..], take(&shapes, &training(Position { epoch: 1, batch: 3 }), 2, 6));
        assert_eq!(all[7].at, Position { epoch: 2, batch: 1 });
        for batch in &all {
            assert_eq!((batch.items.len(), batch.prepared.len()), (4, 4));
            assert!(batch.source.iter().chain(&batch.target).all(|cloud| cloud.len() == 40));
            assert!(batch.prepared.iter().zip(&batch.target).all(|(first, cloud)| *first == cloud[0]));
        }
    }

    #[test]
    fn epochs_take_each_shape_once_in_an_order_of_their_own() {
        let shapes = shapes(14);
        let all = take(&shapes, &training(Position::default()), 2, 6);
        let mut epochs: Vec<Vec<usize>> =
            all.chunks(3).map(|epoch| epoch.iter().flat_map(|batch| batch.items.clone()).collect()).collect();
        assert_ne!(epochs[0], epochs[1]);
        for epoch in &mut epochs {
            epoch.sort_unstable();
            epoch.dedup();
            assert_eq!(epoch.len(), 12);
        }
        let few = take(&self::shapes(3), &training(Position::default()), 2, 2);
        assert!(few.iter().all(|batch| batch.items.len() == 3));
    }

    #[test]
    fn an_evaluation_is_the_protocol_on_every_shape() {
        let shapes = shapes(10);
        let protocol = Protocol::PARTIAL_SHARED.keeping(60);
        let batches = take(&shapes, &Plan::Evaluation(protocol), 3, usize::MAX);
        assert_eq!(batches.iter().map(|b| b.items.len()).collect::<Vec<_>>(), [4, 4, 2]);
        for batch in batches {
            for (i, &item) in batch.items.iter().enumerate() {
                let pair = protocol.pair(&shapes.points(item), item as u64).unwrap();
                assert_eq!(batch.T_target_source[i], pair.T_target_source);
                assert_eq!(batch.source[i][7], pair.source.points[7].map(|v| v as f32));
                assert_eq!(batch.target[i].len(), 60);
            }
        }
    }

    #[test]
    fn protocols_come_as_often_as_they_weigh() {
        let Plan::Training(training) = training(Position::default()) else { unreachable!() };
        let shape = shapes(1).points(0);
        let is_consistent = |pair: &Pair| {
            let moved = pair.T_target_source.apply(pair.source.points[0]);
            pair.target.points.iter().any(|q| moved.iter().zip(q).all(|(a, b)| (a - b).abs() < 1e-9))
        };
        let consistent =
            (0..2000).filter(|&epoch| is_consistent(&training.pair(epoch, 0, &shape).unwrap())).count();
        assert!(consistent.abs_diff(1500) < 80, "{consistent}");
    }

    #[test]
    fn dropping_the_loader_ends_its_threads() {
        let shapes = shapes(10);
        let mut loader = Loader::start(&shapes, &training(Position::default()), 4, 3, |_| Ok(())).unwrap();
        loader.next().unwrap().unwrap();
        assert!(Arc::strong_count(&shapes) > 1);
        drop(loader);
        assert_eq!(Arc::strong_count(&shapes), 1);
    }

    #[test]
    fn what_befalls_prepare_reaches_the_user() {
        let start = |prepare: fn(&Example) -> Result<()>| {
            Loader::start(&shapes(10), &training(Position::default()), 4, 2, prepare).unwrap()
        };
        assert!(start(|_| invalid("k", "too large")).next().unwrap().is_err());
        let mut panics = start(|_| panic!("a mistake"));
        let panic = catch_unwind(AssertUnwindSafe(|| panics.next())).unwrap_err();
        assert_eq!(panic.downcast_ref(), Some(&"a mistake"));
        assert!(panics.next().is_none());
    }

    #[test]
    fn bad_settings_are_refused() {
        let start = |shapes: Arc<Shapes>, plan: Plan, size, threads| {
            Loader::start(&shapes, &plan, size, threads, |_| Ok(())).is_ok()
        };
        let mixed = |mixture, points| {
            Plan::Training(Training {
                mixture,
                points,
                poses: Poses::Fresh,
                seed: 0,
                from: Position::default(),
            })
        };
        let good = || mixed(vec![(Protocol::CONSISTENT, 1.0)], 100);
        assert!(start(shapes(5), good(), 2, 1));
        assert!(!start(shapes(0), good(), 2, 1));
        assert!(!start(shapes(5), good(), 0, 1));
        assert!(!start(shapes(5), good(), 2, 0));
        assert!(!start(shapes(5), mixed(Vec::new(), 50), 2, 1));
        for weight in [0.0, -1.0, f64::NAN] {
            assert!(!start(shapes(5), mixed(vec![(Protocol::CONSISTENT, weight)], 50), 2, 1));
        }
        // A partial cloud of 100 points needs 134.
        let partial = Protocol { coverage: Coverage::PartialShared, ..Protocol::CONSISTENT };
        assert!(!start(shapes(5), mixed(vec![(partial, 1.0)], 100), 2, 1));
        assert!(!start(shapes(5), Plan::Evaluation(Protocol::CONSISTENT), 2, 1));
    }
}
