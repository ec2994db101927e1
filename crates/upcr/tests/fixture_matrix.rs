//! One pair with a known pose through everything a user can choose, and everything that cannot be registered.

#![allow(clippy::unwrap_used, clippy::panic)]

mod common;

use common::consistent::assert_consistent;
use common::{Pair, bumps, normal, seeded, sheet};
use nalgebra::{Matrix3, Vector3, Vector6};
use upcr::{
    CloudRole, Error, Method, PointCloud, Reason, Refinement, Registration, Rigid, RobustKernel, Settings,
    register,
};

/// Methods that find any pose. The network, alone, knows the turns that it learned: it has a test of its own.
const METHODS: [Method; 6] =
    [Method::Auto, Method::Features, Method::Prior, Method::Fgr, Method::Ransac, Method::Consensus];
const REFINEMENTS: [Refinement; 4] =
    [Refinement::Gicp, Refinement::Plane, Refinement::Point, Refinement::None];

/// Where the pair lies and in which unit.
#[derive(Debug, Clone, Copy)]
struct Place {
    /// Clouds' unit over metre.
    scale: f64,
    /// Metres that source and target lie from the origin.
    offsets_m: [[f64; 3]; 2],
}

const AT_HOME: Place = Place { scale: 1.0, offsets_m: [[0.0; 3]; 2] };

/// Where georeferenced scans lie.
const FAR: [[f64; 3]; 2] = [[1.0e6, -2.0e6, 3.0e5], [-1.5e6, 1.0e6, 2.0e5]];

impl Place {
    fn put(&self, pair: &Pair) -> Pair {
        let [source, target] = self.offsets_m.map(Rigid::from_translation);
        let moved = |cloud: &PointCloud, by: &Rigid| {
            let points = cloud.points.iter().map(|&p| by.apply(p).map(|v| v * self.scale)).collect();
            PointCloud::from_points(points)
        };
        let mut truth = target * pair.truth * source.inverse();
        truth.translation *= self.scale;
        let (source, target) = (moved(&pair.source, &source), moved(&pair.target, &target));
        Pair { name: pair.name.clone(), source, target, truth }
    }
}

fn noisy(mut pair: Pair, sigma: f64) -> Pair {
    let mut rng = seeded(1);
    for cloud in [&mut pair.source, &mut pair.target] {
        for point in &mut cloud.points {
            *point = point.map(|v| v + sigma * normal(&mut rng));
        }
    }
    pair
}

/// The truth, turned by 8° about the source's centroid and moved by a twentieth of its size.
fn perturbed(pair: &Pair) -> Rigid {
    let about = Rigid::from_translation(pair.truth.apply(common::centroid(&pair.source).into()));
    let turn = Rigid::exp(&Vector6::new(0.08, -0.08, 0.08, 0.0, 0.0, 0.0));
    let step = Rigid::from_translation([0.03 * pair.size(), -0.03 * pair.size(), 0.03 * pair.size()]);
    step * about * turn * about.inverse() * pair.truth
}

/// Registers `pair` and says what is wrong with the answer, held against its truth.
fn mistakes(pair: &Pair, settings: &Settings) -> (Registration, Vec<String>) {
    let init = (settings.method == Method::Prior).then(|| perturbed(pair));
    let settings = Settings { init, ..settings.clone() };
    let found = register(&pair.source, &pair.target, &settings).unwrap();
    let error = pair.error(&found.T_target_source);
    let case = format!("{} {:?} {:?}", pair.name, settings.method, settings.refine);
    // What is not refined is as good as the features' resolution, or as the first guess.
    let (degrees, share) = if settings.refine == Refinement::None { (12.0, 0.15) } else { (2.0, 0.03) };
    let mut wrong = Vec::new();
    if !error.within(degrees, share * pair.size()) {
        wrong.push(format!("{case}: {error} where the size is {:.3e}", pair.size()));
    }
    if settings.refine != Refinement::None && !found.is_trustworthy() {
        wrong.push(format!("{case}: probability {:.3}, {:?}", found.probability, found.reasons));
    }
    if !matches!(settings.method, Method::Auto | Method::Features) && found.method != settings.method {
        wrong.push(format!("{case}: found by {:?}", found.method));
    }
    assert_consistent(&found);
    (found, wrong)
}

#[track_caller]
fn assert_none(wrong: &[String]) {
    assert!(wrong.is_empty(), "{} mistakes\n{}", wrong.len(), wrong.join("\n"));
}

/// Every method with every refinement, there and back, with and without noise.
#[test]
fn methods_and_refinements() {
    let clean = Pair::sample(1);
    let mut noise = noisy(clean.clone(), 0.01 * clean.size());
    noise.name = "noisy sample".into();
    let mut wrong = Vec::new();
    for pair in [clean.clone(), clean.reversed(), noise.clone(), noise.reversed()] {
        for method in METHODS {
            for refine in REFINEMENTS {
                wrong.extend(mistakes(&pair, &Settings { method, refine, ..Settings::default() }).1);
            }
        }
    }
    assert_none(&wrong);
}

/// The network, alone, on whole clouds turned by up to 45° about each axis, in both directions.
#[test]
fn the_network_within_what_it_learned() {
    let sample = Pair::sample(1);
    for (x, y, z) in [(0.1, 0.2, 0.3), (0.4, 0.1, 0.5), (0.3, 0.6, 0.2)] {
        let truth = Rigid::exp(&Vector6::new(0.0, 0.0, 0.0, 0.01, -0.02, 0.03))
            * Rigid::exp(&Vector6::new(x, 0.0, 0.0, 0.0, 0.0, 0.0))
            * Rigid::exp(&Vector6::new(0.0, y, 0.0, 0.0, 0.0, 0.0))
            * Rigid::exp(&Vector6::new(0.0, 0.0, z, 0.0, 0.0, 0.0));
        let target = sample.source.transformed(&truth);
        let pair = Pair { name: format!("{x} {y} {z}"), source: sample.source.clone(), target, truth };
        for pair in [pair.clone(), pair.reversed()] {
            let settings = Settings { method: Method::Upcr, ..Settings::default() };
            let (found, wrong) = mistakes(&pair, &settings);
            assert_none(&wrong);
            assert_eq!(found.method, Method::Upcr);
        }
    }
}

/// Every method, in millimetres, metres and kilometres, at the origin and far from it.
#[test]
fn units_and_places() {
    let pair = Pair::sample(3);
    let mut wrong = Vec::new();
    for method in METHODS {
        let settings = Settings { method, ..Settings::default() };
        let home = mistakes(&AT_HOME.put(&pair), &settings).0;
        for scale in [1e3, 1.0, 1e-3] {
            for offsets_m in [AT_HOME.offsets_m, FAR] {
                let place = Place { scale, offsets_m };
                let mut pair = place.put(&pair);
                pair.name = format!("{place:?}");
                let (there, mut found_wrong) = mistakes(&pair, &settings);
                let ratio = there.voxel_size / (scale * home.voxel_size);
                if (ratio - 1.0).abs() > 1e-3 {
                    found_wrong.push(format!("{place:?}: the scale does not follow the unit, {ratio}"));
                }
                wrong.append(&mut found_wrong);
            }
        }
    }
    assert_none(&wrong);
}

#[test]
fn kernels_and_overlaps() {
    let pair = Pair::sample(3);
    let mut wrong = Vec::new();
    for kernel in [
        RobustKernel::None,
        RobustKernel::Huber,
        RobustKernel::Cauchy,
        RobustKernel::GemanMcclure,
        RobustKernel::Tukey,
    ] {
        for overlap in [None, Some(0.5), Some(1.0)] {
            let settings = Settings { kernel, overlap, method: Method::Consensus, ..Settings::default() };
            wrong.extend(mistakes(&pair, &settings).1);
        }
    }
    assert_none(&wrong);
}

/// Without refinement, a first guess is what comes back.
#[test]
fn an_unrefined_prior_is_the_first_guess() {
    let pair = Pair::sample(3);
    let init = perturbed(&pair);
    let settings =
        Settings { method: Method::Prior, refine: Refinement::None, init: Some(init), ..Settings::default() };
    let found = register(&pair.source, &pair.target, &settings).unwrap();
    assert!((found.T_target_source.rotation - init.rotation).amax() < 1e-12);
    assert!((found.T_target_source.translation - init.translation).amax() < 1e-12);
}

/// Moving the source beforehand moves the answer with it: `register(T a, b) = register(a, b) T⁻¹`.
#[test]
fn the_answer_follows_the_source() {
    let pair = Pair::sample(3);
    let register = |pair: &Pair| register(&pair.source, &pair.target, &Settings::default()).unwrap();
    let plain = register(&pair);
    let mut rng = seeded(7);
    for _ in 0..6 {
        let mut motion = common::rotation(&mut rng);
        motion.translation = Vector3::from_fn(|_, _| 100.0 * normal(&mut rng));
        let moved = pair.with_source_moved(&motion);
        let expected = plain.T_target_source * motion.inverse();
        let error =
            common::between(&register(&moved).T_target_source, &expected, common::centroid(&moved.source));
        assert!(error.within(0.5, plain.voxel_size / 2.0), "{error}, voxel size {}", plain.voxel_size);
    }
}

/// What `register` says to a source, and to a target, that is no cloud to register.
#[track_caller]
fn assert_refused(bad: &PointCloud, expected: impl Fn(&Error) -> Option<CloudRole>) {
    let good = sheet(30, 1.0, bumps);
    for method in METHODS {
        let settings = Settings { method, ..Settings::default() };
        let as_source = register(bad, &good, &settings).unwrap_err();
        assert_eq!(expected(&as_source), Some(CloudRole::Source), "{as_source}");
        let as_target = register(&good, bad, &settings).unwrap_err();
        assert_eq!(expected(&as_target), Some(CloudRole::Target), "{as_target}");
    }
}

#[test]
fn clouds_that_are_none() {
    let too_few = |e: &Error| match e {
        Error::TooFewPoints { role, .. } => Some(*role),
        _ => None,
    };
    let degenerate = |e: &Error| match e {
        Error::Degenerate { role, .. } => Some(*role),
        _ => None,
    };
    let not_finite = |e: &Error| match e {
        Error::NonFinite { role, first: 5, .. } => Some(*role),
        _ => None,
    };
    assert_refused(&PointCloud::default(), too_few);
    assert_refused(&PointCloud::from_points(vec![[1.0, 2.0, 3.0]]), too_few);
    assert_refused(&PointCloud::from_points(vec![[1.0, 2.0, 3.0], [0.0; 3]]), too_few);
    assert_refused(&PointCloud::from_points(vec![[1.0, 2.0, 3.0]; 500]), degenerate);
    let line = |i: u32| [0.1, -0.7, 0.3].map(|v| 1e6 + v * f64::from(i));
    assert_refused(&PointCloud::from_points((0..500).map(line).collect()), degenerate);
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let mut cloud = sheet(30, 1.0, bumps);
        cloud.points[5][1] = bad;
        assert_refused(&cloud, not_finite);
    }
}

/// Extremes that may be refused or answered, but not with trust, and not with a panic.
#[test]
fn hardly_clouds() {
    let good = sheet(30, 1.0, bumps);
    let triangle = PointCloud::from_points(vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
    let mut doubled = PointCloud::from_points(vec![good.points[0]; 2000]);
    doubled.points.extend_from_slice(&triangle.points);
    let mut outlier = good.clone();
    outlier.points.push([1e12; 3]);
    let huge = PointCloud::from_points(good.points.iter().map(|p| p.map(|v| v * 1e300)).collect());
    let tiny = PointCloud::from_points(good.points.iter().map(|p| p.map(|v| v * 1e-300)).collect());
    for cloud in [triangle, doubled, outlier, huge, tiny] {
        for method in METHODS {
            let settings = Settings { method, ..Settings::default() };
            for (source, target) in [(&cloud, &good), (&good, &cloud)] {
                if let Ok(found) = register(source, target, &settings) {
                    assert_consistent(&found);
                    assert!(!found.is_trustworthy(), "{method:?}: {found:?}");
                }
            }
        }
    }
}

#[test]
fn clouds_that_share_nothing() {
    let near = sheet(40, 1.0, bumps);
    let away = near.transformed(&Rigid::from_translation([1000.0, 0.0, 0.0]));
    for refine in REFINEMENTS {
        let settings = Settings { method: Method::Prior, refine, ..Settings::default() };
        let found = register(&near, &away, &settings).unwrap();
        assert!(!found.converged && found.num_inliers == 0 && !found.is_trustworthy(), "{found:?}");
        assert!(found.reasons.contains(&Reason::NoOverlap), "{:?}", found.reasons);
        assert_consistent(&found);
    }
    // Other surfaces of the same size.
    let other = sheet(40, 0.2, |u, v| 0.5 * ((9.0 * u * v).sin() + (11.0 * (u - v)).cos()));
    let found = register(&Pair::sample(3).source, &other, &Settings::default()).unwrap();
    assert_consistent(&found);
    assert!(!found.is_trustworthy(), "probability {:.3}", found.probability);
}

/// A plane slides on itself: no pose of it is the right one.
#[test]
fn a_flat_sheet() {
    let mut rng = seeded(3);
    let mut flat = || {
        let mut cloud = sheet(60, 1.0, |_, _| 0.0);
        for p in &mut cloud.points {
            *p = p.map(|v| v + 0.002 * normal(&mut rng));
        }
        cloud
    };
    let (source, target) = (flat(), flat());
    let motion = common::rotation(&mut seeded(4));
    for method in METHODS {
        let settings = Settings { method, ..Settings::default() };
        let source = if method == Method::Prior { source.clone() } else { source.transformed(&motion) };
        let found = register(&source, &target, &settings).unwrap();
        assert_consistent(&found);
        assert!(!found.is_trustworthy(), "{method:?}: probability {:.3}", found.probability);
        let told = [Reason::Ambiguous, Reason::DegenerateAxis, Reason::NoOverlap];
        assert!(found.reasons.iter().any(|r| told.contains(r)), "{method:?}: {:?}", found.reasons);
    }
}

/// A refused setting is named.
#[track_caller]
fn assert_names(settings: &Settings, setting: &str) {
    let pair = Pair::sample(6);
    match register(&pair.source, &pair.target, settings) {
        Err(Error::InvalidSetting { name, .. }) => assert_eq!(name, setting),
        other => panic!("{setting} of {settings:?} is not refused: {other:?}"),
    }
}

#[test]
fn settings_out_of_range() {
    for size in [0.0, -0.0, -1.0, f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e-300, 1e-12] {
        assert_names(&Settings { voxel_size: Some(size), ..Settings::default() }, "voxel_size");
    }
    for share in [0.0, -0.5, 1.5, f64::NAN, f64::INFINITY] {
        assert_names(&Settings { overlap: Some(share), ..Settings::default() }, "overlap");
    }
}

/// `Rigid` has open fields: what stands in them need not be a pose.
#[test]
fn a_first_guess_that_is_no_pose() {
    let mut lost = Rigid::identity();
    lost.translation.x = f64::NAN;
    let mut broken = Rigid::identity();
    broken.rotation[(0, 0)] = f64::INFINITY;
    let stretched = Rigid { rotation: Matrix3::identity() * 2.0, ..Rigid::identity() };
    let mirror = Rigid { rotation: -Matrix3::identity(), ..Rigid::identity() };
    for bad in [lost, broken, stretched, mirror] {
        assert_names(&Settings { init: Some(bad), method: Method::Prior, ..Settings::default() }, "init");
    }
}

/// A first guess whose matrix somebody rounded comes back as a rotation, also from where there is nothing to refine.
#[test]
fn a_first_guess_that_is_rounded() {
    let pair = Pair::sample(3);
    let init = perturbed(&pair);
    let init = Rigid { rotation: init.rotation.map(|v| (v * 1e4).round() / 1e4), ..init };
    for method in [Method::Prior, Method::Upcr] {
        let settings = Settings { method, refine: Refinement::None, init: Some(init), ..Settings::default() };
        assert_consistent(&register(&pair.source, &pair.target, &settings).unwrap());
    }
}

/// A scale beyond the clouds leaves nothing to register; that is said, in whichever way.
#[test]
fn a_scale_beyond_the_clouds() {
    let pair = Pair::sample(6);
    for size in [1.0, 1e6, 1e30, 1e300] {
        for method in METHODS {
            let settings = Settings { method, voxel_size: Some(size), ..Settings::default() };
            if let Ok(found) = register(&pair.source, &pair.target, &settings) {
                assert_consistent(&found);
                assert!(!found.is_trustworthy(), "{size:e} {method:?}: {found:?}");
            }
        }
    }
}
