//! The poses that the refinement goes through, as a watcher hears them.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::num::NonZeroUsize;
use std::sync::Mutex;

use common::Pair;
use common::consistent::choices::METHODS;
use nalgebra::Vector3;
use upcr::{
    Locks, Method, PoseStep, Refinement, Registration, Rigid, Settings, Watch, register, register_watched,
};

/// The committed pair far from its origin, with a first guess for the method that needs one.
fn sample(method: Method) -> (Pair, Settings) {
    let place = Rigid::from_translation([500_000.0, 5_400_000.0, 300.0]);
    let mut pair = Pair::sample(2);
    pair.target = pair.target.transformed(&place);
    pair.truth = place * pair.truth;
    let guess = Rigid { translation: pair.truth.translation + Vector3::new(0.01, 0.0, -0.01), ..pair.truth };
    let init = (method == Method::Prior).then_some(guess);
    (pair, Settings { method, init, ..Settings::default() })
}

fn heard(pair: &Pair, settings: &Settings) -> (Registration, Vec<PoseStep>) {
    let steps: Mutex<Vec<PoseStep>> = Mutex::default();
    let hear = |step| steps.try_lock().expect("never twice at once").push(step);
    let watch = Watch { poses: Some(&hear), ..Watch::default() };
    let found = register_watched(&pair.source, &pair.target, settings, &watch).unwrap();
    (found, steps.into_inner().unwrap())
}

/// The answer as JSON, without the times.
fn answer(found: &Registration) -> String {
    let mut json = serde_json::to_value(found).unwrap();
    json.as_object_mut().unwrap().remove("timings_ms").unwrap();
    json.to_string()
}

#[test]
fn listening_changes_nothing() {
    for method in METHODS {
        let (pair, settings) = sample(method);
        let plain = register(&pair.source, &pair.target, &settings).unwrap();
        assert_eq!(answer(&heard(&pair, &settings).0), answer(&plain), "{method:?}");
    }
}

#[test]
fn each_hypothesis_is_followed_to_its_end_and_one_of_them_is_the_answer() {
    for method in METHODS {
        let (pair, settings) = sample(method);
        let (found, steps) = heard(&pair, &settings);
        for (i, step) in steps.iter().enumerate() {
            let before = i.checked_sub(1).map(|i| &steps[i]);
            if step.iteration == 0 {
                assert_eq!(step.hypothesis, before.map_or(0, |b| b.hypothesis + 1), "{method:?}");
                assert!(!step.fine && step.pairs.is_none());
            } else {
                let before = before.unwrap();
                assert_eq!((step.hypothesis, step.method), (before.hypothesis, before.method));
                assert_eq!(step.iteration, before.iteration + 1, "{method:?}");
                assert!(step.fine || !before.fine, "coarse before fine");
                let pairs = step.pairs.unwrap();
                assert!(pairs.share > 0.0 && pairs.share <= 1.0 && pairs.rmse.is_finite(), "{pairs:?}");
            }
        }
        if steps.is_empty() {
            // The network alone does not find this pair.
            assert_eq!((method, found.iterations), (Method::Upcr, 0));
            continue;
        }
        let followed: Vec<&[PoseStep]> = steps.chunk_by(|a, b| a.hypothesis == b.hypothesis).collect();
        let fine = |way: &[PoseStep]| way.iter().filter(|step| step.fine).count();
        let accepted =
            followed.iter().find(|way| way.last().unwrap().T_target_source == found.T_target_source);
        let Some(accepted) = accepted else { panic!("{method:?}: {} of {found:?}", steps.len()) };
        assert_eq!((fine(accepted), accepted[0].method), (found.iterations, found.method));
    }
}

/// A guess that is some voxels off comes nearer from the first iteration to the last.
#[test]
fn poses_lead_from_the_guess_to_the_answer() {
    let (pair, settings) = sample(Method::Prior);
    let (found, steps) = heard(&pair, &settings);
    let middle = common::centroid(&pair.source);
    let off = |pose: &Rigid| common::between(pose, &found.T_target_source, middle).centroid;
    assert!(off(&steps[0].T_target_source) > 0.01);
    let given = settings.init.unwrap();
    assert!(common::between(&steps[0].T_target_source, &given, middle).within(1e-9, 1e-8));
    let first = steps.iter().take_while(|step| step.hypothesis == 0);
    let first: Vec<f64> = first.map(|step| off(&step.T_target_source)).collect();
    assert!(first.last().unwrap() < &(0.1 * first[0]), "{first:?}");
}

#[test]
fn the_order_does_not_depend_on_the_threads() {
    let (pair, settings) = sample(Method::Features);
    let on = |threads| heard(&pair, &Settings { threads: NonZeroUsize::new(threads), ..settings.clone() }).1;
    assert_eq!(on(1), on(3));
}

#[test]
fn locked_axes_are_held_on_the_way() {
    let (pair, settings) = sample(Method::Prior);
    let locks = Locks { x: true, z: true, ..Locks::default() };
    let (found, steps) = heard(&pair, &Settings { locks, ..settings });
    for step in steps {
        let t = step.T_target_source.translation;
        let held = found.T_target_source.translation;
        assert_eq!([t[0], t[2]], [held[0], held[2]]);
    }
}

#[test]
fn without_refinement_the_hypotheses_alone_are_heard() {
    let (pair, settings) = sample(Method::Prior);
    let (found, steps) = heard(&pair, &Settings { refine: Refinement::None, ..settings });
    assert!(steps.iter().all(|step| step.iteration == 0 && !step.fine) && !steps.is_empty());
    assert!(steps.iter().any(|step| step.T_target_source == found.T_target_source));
}

/// What is asked beside the work, whether another scale fits, is not part of the way to the answer.
#[test]
fn questions_of_scale_are_not_heard() {
    let mut pair = Pair::sample(2);
    pair.source = pair.source.scaled(1000.0);
    let (found, steps) = heard(&pair, &Settings::default());
    assert!(found.source_scale.is_some());
    assert!(
        steps
            .windows(2)
            .all(|w| w[1].hypothesis == w[0].hypothesis || w[1].hypothesis == w[0].hypothesis + 1)
    );
}
