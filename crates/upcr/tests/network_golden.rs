//! The network against a plain form of it in another framework; `golden/README.md` says how its values were made.

#![allow(clippy::unwrap_used)]

use std::path::Path;

use safetensors::SafeTensors;
use upcr::net::Network;

const CLOUDS: [&str; 4] = ["source.0", "source.1", "target.0", "target.1"];
const FILES: [&str; 3] = ["upcr_network", "upcr_network_dynamic", "upcr_network_none"];

fn bytes(file: &str) -> Vec<u8> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
    std::fs::read(folder.join(file).with_extension("safetensors")).unwrap()
}

fn values(tensors: &SafeTensors, name: &str) -> Vec<f32> {
    let tensor = tensors.tensor(name).unwrap();
    tensor.data().as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
}

fn cloud(tensors: &SafeTensors, name: &str) -> Vec<[f32; 3]> {
    values(tensors, &format!("input.{name}")).as_chunks::<3>().0.to_vec()
}

/// Agreement to 1e-4, relative where values are large.
fn assert_close(ours: &[f32], theirs: &[f32], what: &str) {
    assert_eq!(ours.len(), theirs.len(), "{what}");
    let scale = theirs.iter().fold(1.0_f32, |scale, v| scale.max(v.abs()));
    let worst = ours.iter().zip(theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst < 1e-4 * scale, "{what}: {worst} of {scale}");
}

#[test]
fn representations_are_those_of_the_plain_network() {
    for file in FILES {
        let bytes = bytes(file);
        let golden = SafeTensors::deserialize(&bytes).unwrap();
        let network = Network::from_safetensors(&bytes).unwrap();
        for name in CLOUDS {
            let ours = network.representations(&cloud(&golden, name)).unwrap();
            let theirs = |part: &str| values(&golden, &format!("eval.{name}.{part}"));
            assert_close(&ours.global, &theirs("global"), &format!("{file} {name} global"));
            assert_close(&ours.invariant, &theirs("invariant"), &format!("{file} {name} invariant"));
            assert_close(&ours.pose, &theirs("pose"), &format!("{file} {name} pose"));
            assert_close(&ours.head, &theirs("head"), &format!("{file} {name} head"));
        }
    }
}

#[test]
fn poses_are_those_of_the_plain_network() {
    for file in FILES {
        let bytes = bytes(file);
        let golden = SafeTensors::deserialize(&bytes).unwrap();
        let network = Network::from_safetensors(&bytes).unwrap();
        let (rotations, translations) =
            (values(&golden, "eval.rotation"), values(&golden, "eval.translation"));
        for pair in 0..2 {
            let [source, target] = ["source", "target"].map(|role| cloud(&golden, &format!("{role}.{pair}")));
            let pose = network.predict(&source, &target).unwrap();
            let rotation: Vec<f32> = pose.rotation.transpose().iter().map(|v| *v as f32).collect();
            let translation: Vec<f32> = pose.translation.iter().map(|v| *v as f32).collect();
            assert_close(&rotation, &rotations[9 * pair..][..9], &format!("{file} R {pair}"));
            assert_close(&translation, &translations[3 * pair..][..3], &format!("{file} t {pair}"));
        }
    }
}
