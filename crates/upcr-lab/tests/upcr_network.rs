//! The network against a plain form of it in another framework (crates/upcr/tests/golden/README.md).
#![cfg(feature = "train")]
#![allow(missing_docs, clippy::unwrap_used, clippy::panic)]

use std::path::Path;

use burn::module::Param;
use burn::tensor::{Device, Tensor};
use rand::Rng;
use upcr::net::{Graph, Invariant, Network, NetworkConfig};
use upcr_lab::models::tensor_file::TensorFile;
use upcr_lab::models::weights::restore;
use upcr_lab::models::{CloudInput, Clouds, LearnedConfig, NormalizedLayer, Statistics};
use upcr_lab::random;

fn golden(name: &str) -> TensorFile {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../upcr/tests/golden").join(name);
    TensorFile::from_bytes(&std::fs::read(&path).unwrap(), &path).unwrap()
}

fn values(file: &TensorFile, name: &str) -> Vec<f32> {
    file.tensors.get(name).unwrap_or_else(|| panic!("{name}")).to_f32().unwrap()
}

const ROLES: [&str; 4] = ["source.0", "source.1", "target.0", "target.1"];

fn clouds(file: &TensorFile, config: &NetworkConfig) -> Clouds {
    let mut inputs: Vec<CloudInput> = ROLES
        .iter()
        .map(|role| {
            let points = values(file, &format!("input.{role}"));
            let input = CloudInput::new(points.as_chunks::<3>().0, config).unwrap();
            let graph = &file.tensors[&format!("graph.{role}")];
            let neighbors: Vec<u32> =
                graph.bytes.as_chunks::<4>().0.iter().map(|b| u32::from_le_bytes(*b)).collect();
            // The same neighbours; among themselves in another order, perhaps.
            let sorted = |g: &Graph| -> Vec<Vec<u32>> {
                (0..g.len())
                    .map(|i| {
                        let mut row = g.row(i).to_vec();
                        row.sort_unstable();
                        row
                    })
                    .collect()
            };
            assert_eq!(sorted(&input.graph), sorted(&Graph { k: config.k, neighbors }), "{role}");
            input
        })
        .collect();
    let targets = inputs.split_off(2);
    let pairs: Vec<_> = inputs.into_iter().zip(targets).collect();
    Clouds::new(&pairs, config.k)
}

#[track_caller]
fn assert_close(what: &str, found: &[f32], expected: &[f32], tolerance: f32) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let scale = expected.iter().fold(1.0_f32, |s, v| s.max(v.abs()));
    let worst = found.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max) / scale;
    assert!(worst <= tolerance, "{what}: {worst} off");
}

fn flat<const D: usize>(tensor: &Tensor<D>) -> Vec<f32> {
    tensor.clone().into_data().try_to_vec().unwrap()
}

#[test]
fn use_gives_the_golden_values() {
    for name in ["upcr_network", "upcr_network_dynamic", "upcr_network_none"] {
        let file = golden(&format!("{name}.safetensors"));
        let network = restore(&file, Path::new(name), &Device::flex()).unwrap();
        let clouds = clouds(&file, &network.config);
        let output = network.forward(&clouds, Statistics::Running);
        let m = network.config.representation();
        let mut parts = vec![("global", flat(&output.global)), ("pose", flat(&output.pose_related))];
        parts.extend(output.invariant.as_ref().map(|tensor| ("invariant", flat(tensor))));
        for (part, found) in parts {
            for (cloud, role) in ROLES.iter().enumerate() {
                let expected = values(&file, &format!("eval.{role}.{part}"));
                assert_close(&format!("{name} {role} {part}"), &found[cloud * m..][..m], &expected, 1e-4);
            }
        }
        let (rotations, translations) = (values(&file, "eval.rotation"), values(&file, "eval.translation"));
        for (pair, pose) in output.poses(&clouds).iter().enumerate() {
            let rotation: Vec<f32> = pose.rotation.transpose().iter().map(|&v| v as f32).collect();
            let translation: Vec<f32> = pose.translation.iter().map(|&v| v as f32).collect();
            assert_close(&format!("{name} R"), &rotation, &rotations[pair * 9..][..9], 1e-4);
            assert_close(&format!("{name} t"), &translation, &translations[pair * 3..][..3], 1e-4);
        }
    }
}

#[test]
fn learning_gives_the_golden_loss_and_gradients() {
    for name in ["upcr_network", "upcr_network_none"] {
        let file = golden(&format!("{name}.safetensors"));
        let network = restore(&file, Path::new(name), &Device::flex().autodiff()).unwrap();
        let clouds = clouds(&file, &network.config);
        let output = network.forward(&clouds, Statistics::Batch);
        let layers = (0..network.global.len()).map(|l| format!("global.{l}"));
        let branch = (0..network.invariant.len()).map(|l| format!("invariant.{l}"));
        let names: Vec<String> =
            layers.chain(network.embed.iter().map(|_| "invariant.embed".into())).chain(branch).collect();
        for (layer, [mean, var]) in names.iter().zip(&output.statistics) {
            for (part, found) in [("mean", mean), ("var", var)] {
                let expected = values(&file, &format!("train.{layer}.{part}"));
                assert_close(&format!("{name} {layer}.{part}"), &flat(found), &expected, 1e-4);
            }
        }
        let loss = output.loss(&clouds).mean();
        assert_close("loss", &flat(&loss), &values(&file, "train.loss"), 1e-4);

        let gradients = loss.backward();
        let check = |parameter: &str, found: Vec<f32>| {
            let expected = values(&file, &format!("train.grad.{parameter}"));
            let scale = expected.iter().map(|v| v.abs()).fold(0.0, f32::max);
            let worst = found.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            // Single precision through five layers and a Chamfer distance.
            assert!(worst <= 5e-4 * scale.max(1e-3), "{name} {parameter}: {worst} off of {scale}");
        };
        let gradient2 = |p: &Param<Tensor<2>>| flat(&p.val().grad(&gradients).unwrap());
        let gradient1 = |p: &Param<Tensor<1>>| flat(&p.val().grad(&gradients).unwrap());
        let normalized: Vec<&NormalizedLayer> = network.normalized_layers().collect();
        for (layer, parameters) in names.iter().zip(normalized) {
            check(&format!("{layer}.weight"), gradient2(&parameters.weight));
            check(&format!("{layer}.gamma"), gradient1(&parameters.gamma));
            check(&format!("{layer}.beta"), gradient1(&parameters.beta));
        }
        for (l, linear) in network.head.iter().enumerate() {
            check(&format!("head.{l}.weight"), gradient2(&linear.weight));
            check(&format!("head.{l}.bias"), gradient1(&linear.bias));
        }
    }
}

#[test]
fn use_sees_flat_surfaces_as_learning_did() {
    // Faces of a box, away from the origin: there nothing but rounding chooses the sides of normals.
    let mut rng = random::stream(21, 0);
    let mut cloud = || -> Vec<[f32; 3]> {
        (0..200)
            .map(|i| {
                let mut p = [0.3, 0.2, 0.5].map(|side| rng.random_range(-side..side));
                p[i % 3] = [0.3, 0.2, 0.5][i % 3] * if i % 2 == 0 { 1.0 } else { -1.0 };
                [p[0] + 0.37, p[1] - 1.21, p[2] + 0.77]
            })
            .collect()
    };
    for invariant in [Invariant::Spfh, Invariant::Pfh, Invariant::DistancePpfSpfh] {
        let config = NetworkConfig {
            k: 8,
            widths: vec![16, 32],
            head: vec![16],
            invariant,
            ..NetworkConfig::default()
        };
        let network = LearnedConfig::Upcr(config).init(3, &Device::flex()).unwrap();
        let in_use = Network::from_safetensors(&network.store().to_bytes().unwrap()).unwrap();
        let (source, target) = (cloud(), cloud());
        let expected = network.predict(source.clone(), target.clone()).unwrap();
        let found = in_use.predict(&source, &target).unwrap();
        let off = (found.rotation - expected.rotation).amax();
        let moved = (found.translation - expected.translation).amax();
        assert!(off < 1e-5 && moved < 1e-5, "{invariant:?}: {off} {moved}");
    }
}
