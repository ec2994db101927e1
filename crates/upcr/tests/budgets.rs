//! Limits of time, cancellation and progress.

#![allow(clippy::unwrap_used)]

mod common;

use std::num::NonZeroUsize;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use common::Pair;
use common::consistent::choices::METHODS;
use nalgebra::Vector3;
use rand::Rng;
use upcr::{
    Error, Method, PointCloud, Progress, Reason, Registration, Rigid, Settings, Stage, TRUSTWORTHY, Watch,
    register, register_watched,
};

/// Held by what takes long on all threads: one would wait for the other.
static ALONE: Mutex<()> = Mutex::new(());

/// The committed pair, with a first guess for the method that needs one.
fn sample(method: Method) -> (Pair, Settings) {
    let pair = Pair::sample(2);
    let guess = Rigid { translation: pair.truth.translation + Vector3::new(0.01, 0.0, -0.01), ..pair.truth };
    let init = (method == Method::Prior).then_some(guess);
    (pair, Settings { method, init, threads: NonZeroUsize::new(1), ..Settings::default() })
}

/// What takes long: points drawn from a surface, and a scale that keeps most of them.
fn slow() -> (PointCloud, PointCloud, Settings) {
    let cloud = |seed| {
        let mut rng = common::seeded(seed);
        let points = (0..200_000).map(|_| {
            let (u, v): (f64, f64) = (rng.random(), rng.random());
            [u, v, common::bumps(u, v)]
        });
        PointCloud::from_points(points.collect())
    };
    (cloud(1), cloud(2), Settings { voxel_size: Some(0.001), ..Settings::default() })
}

/// The answer as JSON, without the times and the budgets.
fn answer(found: &Registration) -> String {
    let mut json = serde_json::to_value(found).unwrap();
    json.as_object_mut().unwrap().remove("timings_ms").unwrap();
    for name in ["max_seconds", "max_memory_bytes"] {
        json["settings"].as_object_mut().unwrap().remove(name).unwrap();
    }
    json.to_string()
}

#[test]
fn budgets_that_are_not_reached_change_nothing() {
    for method in METHODS {
        let (pair, settings) = sample(method);
        let plain = register(&pair.source, &pair.target, &settings).unwrap();
        assert_eq!(plain.points_used, [pair.source.len(), pair.target.len()]);
        let ample =
            Settings { max_seconds: Some(1e300), max_memory_bytes: Some(1 << 32), ..settings.clone() };
        let watch = Watch { cancelled: Some(&|| false), progress: Some(&|_| ()), poses: Some(&|_| ()) };
        let watched = register_watched(&pair.source, &pair.target, &ample, &watch).unwrap();
        assert_eq!(answer(&watched), answer(&plain), "{method:?}");
    }
}

#[test]
fn no_time_is_an_answer_at_once() {
    for method in METHODS {
        let (pair, settings) = sample(method);
        let settings = Settings { max_seconds: Some(0.0), ..settings };
        let found = register(&pair.source, &pair.target, &settings).unwrap();
        assert_eq!(found.reasons, [Reason::TimeLimit]);
        assert_eq!((found.probability, found.converged, found.num_inliers), (0.0, false, 0));
        assert_eq!(found.T_target_source, settings.init.unwrap_or_else(Rigid::identity));
        assert!(found.covariance.iter().flatten().all(|v| v.is_finite()), "{:?}", found.covariance);
        assert!((0..6).all(|i| found.covariance[i][i] > 0.0), "nothing is known of the pose");
    }
}

#[test]
fn a_time_limit_is_kept() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let (source, target, settings) = slow();
    let timed = |settings: &Settings| {
        let start = Instant::now();
        (register(&source, &target, settings).unwrap(), start.elapsed().as_secs_f64())
    };
    let (full, seconds) = timed(&settings);
    assert!(!full.reasons.contains(&Reason::TimeLimit));
    for share in [0.01, 0.1, 0.4] {
        let limit = share * seconds;
        let (found, took) = timed(&Settings { max_seconds: Some(limit), ..settings.clone() });
        assert_eq!(found.reasons.last(), Some(&Reason::TimeLimit), "{limit} s of {seconds} s");
        assert!(!found.converged && found.probability < TRUSTWORTHY);
        assert!(took < limit + 0.3 * seconds, "{took} s, where {limit} s of {seconds} s were allowed");
    }
}

#[test]
fn cancelling_from_another_thread_ends_the_call() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let (source, target, settings) = slow();
    let start = Instant::now();
    register(&source, &target, &settings).unwrap();
    let full = start.elapsed();
    let cancelled = AtomicBool::new(false);
    let ask = || cancelled.load(Ordering::Relaxed);
    let watch = Watch { cancelled: Some(&ask), ..Watch::default() };
    let start = Instant::now();
    let found = std::thread::scope(|scope| {
        scope.spawn(|| {
            std::thread::sleep(Duration::from_millis(20));
            cancelled.store(true, Ordering::Relaxed);
        });
        register_watched(&source, &target, &settings, &watch).unwrap()
    });
    let took = start.elapsed();
    assert_eq!(found.reasons.last(), Some(&Reason::Cancelled));
    assert!(!found.converged && found.probability < TRUSTWORTHY);
    assert!(took < full / 2, "{took:?} of {full:?}");
}

/// Ends the call in many places: where it asks for the first, fourth, sixteenth, … time whether to end, and where for the
/// last, last but one, but three, …
#[test]
fn wherever_it_ends_the_best_pose_so_far_comes_back() {
    for method in METHODS {
        let (pair, settings) = sample(method);
        let run = |last: usize| {
            let asked = AtomicUsize::new(0);
            let cancelled = || asked.fetch_add(1, Ordering::Relaxed) + 1 >= last;
            let watch = Watch { cancelled: Some(&cancelled), ..Watch::default() };
            let found = register_watched(&pair.source, &pair.target, &settings, &watch).unwrap();
            (found, asked.load(Ordering::Relaxed))
        };
        let is_right = |found: &Registration| {
            found.num_inliers > 0 && pair.error(&found.T_target_source).within(5.0, 0.05)
        };
        let (full, all) = run(usize::MAX);
        let first = (0..).map(|i| 1 << (2 * i)).take_while(|&n| n <= all);
        let last = (0..).map(|i| 1 << i).take_while(|&n| n < all).map(|n| all + 1 - n);
        let (mut ended, mut right) = (0, 0);
        for last in first.chain(last) {
            let (found, asked) = run(last);
            assert_eq!(asked, last, "{method:?}: asked no more once it said yes");
            assert_eq!(found.reasons.last(), Some(&Reason::Cancelled), "{method:?} after {last} of {all}");
            assert!(!found.converged && (0.0..=1.0).contains(&found.probability));
            if found.num_inliers == 0 {
                assert_eq!(found.probability, 0.0, "nothing is claimed of a pose that nothing was seen of");
            }
            ended += 1;
            right += usize::from(is_right(&found));
        }
        assert!(ended > 10, "{method:?} asks {all} times");
        // The network alone does not find this pair, whole or cut short.
        assert!(right > 2 || !is_right(&full), "{method:?}: right {right} times of {ended}");
    }
}

/// Rivals that were not looked at might be as good: no pose is trusted before.
#[test]
fn a_pose_that_was_not_compared_is_not_trusted() {
    let (pair, settings) = sample(Method::Consensus);
    let cancelled = AtomicBool::new(false);
    let refining = AtomicUsize::new(0);
    let hear = |p: Progress| {
        if p.stage == Stage::Refine {
            refining.fetch_add(1, Ordering::Relaxed);
        }
        // Within the refinement, at its first finely refined pose.
        cancelled.store(refining.load(Ordering::Relaxed) == 2, Ordering::Relaxed);
    };
    let ask = || cancelled.load(Ordering::Relaxed);
    let watch = Watch { cancelled: Some(&ask), progress: Some(&hear), ..Watch::default() };
    let found = register_watched(&pair.source, &pair.target, &settings, &watch).unwrap();
    assert!(found.reasons.contains(&Reason::Cancelled) && found.num_inliers > 0, "{found:?}");
    assert!(pair.error(&found.T_target_source).within(5.0, 0.05));
    assert!(found.probability > 0.0 && !found.is_trustworthy());
    assert!(register(&pair.source, &pair.target, &settings).unwrap().is_trustworthy());
}

#[test]
fn progress_goes_from_nothing_to_all() {
    let mut apart = Pair::sample(2);
    apart.target = common::sheet(60, 0.2, common::bumps);
    for (pair, methods) in [
        (Pair::sample(2), vec![None, Some(Method::Consensus)]),
        (apart, vec![None, Some(Method::Consensus), Some(Method::Fgr), Some(Method::Ransac)]),
    ] {
        let told: Mutex<Vec<Progress>> = Mutex::default();
        let hear = |p| told.try_lock().expect("never twice at once").push(p);
        let watch = Watch { progress: Some(&hear), ..Watch::default() };
        let settings = Settings { threads: NonZeroUsize::new(1), ..Settings::default() };
        register_watched(&pair.source, &pair.target, &settings, &watch).unwrap();
        let told = told.into_inner().unwrap();
        assert!(told.windows(2).all(|w| w[0].done <= w[1].done), "{told:?}");
        assert_eq!((told[0].stage, told[0].done), (Stage::Prepare, 0.0));
        assert_eq!(told.iter().filter(|p| p.done >= 1.0).count(), 1);
        assert_eq!(told.last().map(|p| (p.stage, p.done)), Some((Stage::Verify, 1.0)));
        for stage in [Stage::Prepare, Stage::Hypotheses, Stage::Refine, Stage::Verify] {
            assert!(told.iter().any(|p| p.stage == stage), "{stage}");
        }
        let mut heard: Vec<Option<Method>> = told.iter().map(|p| p.method).collect();
        heard.dedup();
        assert_eq!(heard, methods);
    }
}

#[test]
fn a_call_that_ends_early_tells_so_too() {
    let (pair, settings) = sample(Method::Auto);
    let told: Mutex<Vec<Progress>> = Mutex::default();
    let hear = |p| told.lock().unwrap().push(p);
    let watch = Watch { cancelled: Some(&|| true), progress: Some(&hear), ..Watch::default() };
    register_watched(&pair.source, &pair.target, &settings, &watch).unwrap();
    let told = told.into_inner().unwrap();
    assert_eq!(told.last().map(|p| (p.stage, p.done)), Some((Stage::Prepare, 1.0)));
}

#[test]
fn impossible_times_are_refused() {
    let (pair, settings) = sample(Method::Auto);
    for seconds in [-1.0, f64::NAN, f64::INFINITY] {
        let settings = Settings { max_seconds: Some(seconds), ..settings.clone() };
        let refused = register(&pair.source, &pair.target, &settings).unwrap_err();
        assert!(matches!(refused, Error::InvalidSetting { name: "max_seconds", .. }), "{refused}");
    }
}
