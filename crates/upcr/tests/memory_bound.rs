//! A registration takes no more memory than it may.
#![allow(missing_docs, clippy::unwrap_used)]

mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::num::NonZeroUsize;
use std::sync::atomic::{AtomicUsize, Ordering};

use nalgebra::{Rotation3, Vector3};
use rand::Rng;
use upcr::features::MatchedFeature;
use upcr::{Error, Method, PointCloud, Registration, Rigid, Settings, register};

/// The system's allocator, which knows how much is in use and how much ever was.
struct Counting;

static IN_USE: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

// SAFETY: all is left to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let in_use = IN_USE.fetch_add(layout.size(), Ordering::Relaxed) + layout.size();
        PEAK.fetch_max(in_use, Ordering::Relaxed);
        // SAFETY: as the caller's.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        IN_USE.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: as the caller's.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// The result and the most bytes in use while it was found.
fn measured(
    source: &PointCloud,
    target: &PointCloud,
    settings: &Settings,
) -> (upcr::Result<Registration>, u64) {
    let before = IN_USE.load(Ordering::Relaxed);
    PEAK.store(before, Ordering::Relaxed);
    let found = register(source, target, settings);
    (found, (PEAK.load(Ordering::Relaxed) - before) as u64)
}

/// Points drawn from a bumpy surface.
fn surface(points: usize, seed: u64) -> PointCloud {
    let mut rng = common::seeded(seed);
    let mut point = || {
        let (u, v): (f64, f64) = (rng.random(), rng.random());
        [u, v, common::bumps(u, v)]
    };
    PointCloud::from_points((0..points).map(|_| point()).collect())
}

/// Points drawn from a cube: as many cells as can be.
fn volume(points: usize, seed: u64) -> PointCloud {
    let mut rng = common::seeded(seed);
    PointCloud::from_points((0..points).map(|_| [rng.random(), rng.random(), rng.random()]).collect())
}

// One test: another's memory would count as well.
#[test]
fn the_bound_holds() {
    let clouds = [
        ("some", surface(6000, 1), surface(6000, 2)),
        ("many and few", surface(150_000, 1), surface(1500, 2)),
        ("many", surface(150_000, 1), surface(150_000, 2)),
        ("scattered", volume(100_000, 1), volume(100_000, 2)),
    ];
    // First of all the one that loads the network.
    let methods = [Method::Upcr, Method::Features, Method::Prior];
    let mut thinned = 0;
    for (name, source, target) in &clouds {
        for method in methods {
            for voxel_size in [None, Some(0.03), Some(0.003)] {
                for (mib, feature) in [(14, MatchedFeature::Pfh), (32, MatchedFeature::Fpfh)] {
                    let bound = mib << 20;
                    let settings = Settings {
                        method,
                        voxel_size,
                        feature,
                        max_memory_bytes: Some(bound),
                        ..Settings::default()
                    };
                    let (found, peak) = measured(source, target, &settings);
                    let used = found.unwrap().points_used;
                    assert!(peak <= bound, "{name}, {settings:?}: {peak} bytes with {used:?} points");
                    for (used, all) in used.into_iter().zip([source.len(), target.len()]) {
                        assert!(used <= all && used >= all.min(1000), "{name}, {settings:?}: {used}");
                        thinned += usize::from(used < all);
                    }
                }
            }
        }
    }
    assert!(thinned > 30, "{thinned}");
    only_what_must_be_is_thinned(&clouds[2].1, &clouds[2].2);
    the_least_bound_is_told_and_suffices(&clouds[2].1, &clouds[2].2);
}

fn only_what_must_be_is_thinned(source: &PointCloud, target: &PointCloud) {
    let motion = Rigid {
        rotation: Rotation3::from_euler_angles(0.3, -0.8, 2.0).into_inner(),
        translation: Vector3::new(0.5, 2.0, -1.0),
    };
    let target = target.transformed(&motion);
    let found = |max_memory_bytes, voxel_size, threads| {
        let threads = NonZeroUsize::new(threads);
        let settings = Settings { max_memory_bytes, voxel_size, threads, ..Settings::default() };
        register(source, &target, &settings).unwrap()
    };
    // Dense clouds need no more cells than sparse ones.
    let whole = found(Some(20 << 20), None, 2);
    assert_eq!(whole.points_used, [source.len(), target.len()]);
    assert_eq!(whole.T_target_source, found(None, None, 2).T_target_source);
    // With cells as small as the points' distances, half of them fit and do as well.
    let half = found(Some(40 << 20), Some(0.004), 2);
    assert!(half.points_used[0] < source.len() && half.is_trustworthy(), "{half:?}");
    let off = common::between(&half.T_target_source, &motion, Vector3::zeros());
    assert!(off.within(0.5, 0.01), "{off}");
    let again = found(Some(40 << 20), Some(0.004), 1);
    assert_eq!((again.T_target_source, again.points_used), (half.T_target_source, half.points_used));
}

fn the_least_bound_is_told_and_suffices(source: &PointCloud, target: &PointCloud) {
    let bounded = |bound| Settings { max_memory_bytes: Some(bound), ..Settings::default() };
    let refused = register(source, target, &bounded(1000)).unwrap_err();
    let Error::TooLittleMemory { given: 1000, needed } = refused else {
        unreachable!("{refused}");
    };
    assert!(refused.to_string().contains(&needed.to_string()));
    let (found, peak) = measured(source, target, &bounded(needed));
    assert!(found.unwrap().points_used.iter().all(|&n| n >= 1000) && peak <= needed, "{peak} of {needed}");
}
