//! Weights files that are not what they should be, and those that are.

#![allow(clippy::unwrap_used, clippy::panic)]

#[path = "common/weights.rs"]
mod weights;

use upcr::Error;
use upcr::net::{Network, NetworkConfig};
use weights::{Precision, WeightsFile};

fn config() -> NetworkConfig {
    NetworkConfig { k: 4, widths: vec![4, 8], head: vec![5], ..Default::default() }
}

/// What is said about a small network's file after `change`.
fn refusal(change: impl Fn(&mut WeightsFile)) -> String {
    let mut file = WeightsFile::random(&config(), 7);
    change(&mut file);
    match Network::from_safetensors(&file.bytes(Precision::Single)) {
        Err(Error::InvalidWeights { reason } | Error::InvalidSetting { reason, .. }) => reason,
        other => panic!("{other:?}"),
    }
}

#[test]
fn every_missing_tensor_is_named() {
    let file = WeightsFile::random(&config(), 7);
    assert!(Network::from_safetensors(&file.bytes(Precision::Single)).is_ok());
    for name in file.tensors.keys() {
        let reason = refusal(|file| drop(file.tensors.remove(name)));
        assert!(reason.contains(name.as_str()) && reason.contains("missing"), "{reason}");
    }
}

#[test]
fn shapes_that_do_not_fit_are_refused() {
    for name in WeightsFile::random(&config(), 7).tensors.keys() {
        let reason = refusal(|file| {
            let (shape, values) = file.tensors.get_mut(name).unwrap();
            shape[0] += 1;
            values.resize(shape.iter().product(), 0.0);
        });
        assert!(reason.contains(name.as_str()) && reason.contains("shape"), "{reason}");
    }
}

#[test]
fn values_that_are_no_numbers_are_refused() {
    for value in [f32::NAN, f32::INFINITY] {
        let reason = refusal(|file| file.tensors.get_mut("global.1.weight").unwrap().1[9] = value);
        assert!(reason.contains("global.1.weight"), "{reason}");
    }
    let reason = refusal(|file| file.tensors.get_mut("global.0.var").unwrap().1[2] = -0.5);
    assert!(reason.contains("variance"), "{reason}");
}

#[test]
fn configurations_that_make_no_network_are_refused() {
    let with = |text: &str| refusal(|file| drop(file.metadata.insert("upcr.config".into(), text.into())));
    assert!(refusal(|file| file.metadata.clear()).contains("upcr.config"));
    assert!(with("{").contains("upcr.config"));
    assert!(with(r#"{"depth": 3}"#).contains("depth"));
    assert!(with(r#"{"k": 0}"#).contains("neighbours"));
    assert!(with(r#"{"widths": []}"#).contains("layer"));
    assert!(with(r#"{"widths": [99999999999]}"#).contains("channels"));
    // Larger than the file.
    assert!(with(r#"{"widths": [16384, 16384]}"#).contains("shape"));
}

#[test]
fn bytes_that_are_no_file_are_refused() {
    let whole = WeightsFile::random(&config(), 7).bytes(Precision::Single);
    for length in (0..whole.len()).step_by(97) {
        assert!(Network::from_safetensors(&whole[..length]).is_err(), "the first {length} bytes");
    }
    // Every bit of the header turned, one at a time: an error or a network, no panic.
    let header = 8 + u64::from_le_bytes(whole[..8].try_into().unwrap()) as usize;
    let mut refused = 0;
    for bit in 0..8 * header {
        let mut bytes = whole.clone();
        bytes[bit / 8] ^= 1 << (bit % 8);
        refused += usize::from(Network::from_safetensors(&bytes).is_err());
    }
    assert!(refused > 4 * header, "{refused} of {}", 8 * header);
}

#[test]
fn half_precision_is_read() {
    let mut file = WeightsFile::random(&config(), 7);
    for (_, values) in file.tensors.values_mut() {
        for v in values {
            *v = f32::from_bits(v.to_bits() & 0xffff_0000);
        }
    }
    let cloud: Vec<[f32; 3]> =
        (0..40).map(|i| [i as f32 % 7.0, (i * i) as f32 % 5.0, i as f32 * 0.1]).collect();
    let [single, half] = [Precision::Single, Precision::BrainFloat].map(|precision| {
        let network = Network::from_safetensors(&file.bytes(precision)).unwrap();
        network.representations(&cloud).unwrap()
    });
    assert_eq!(single, half);
}

#[test]
fn a_file_that_is_none_is_named() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml");
    let error = Network::load(&path).unwrap_err();
    assert!(matches!(&error, Error::Malformed { path: named, .. } if *named == path), "{error}");
    let error = Network::load("no/such/file").unwrap_err();
    assert!(matches!(error, Error::Io { .. }), "{error}");
}

#[test]
fn clouds_that_cannot_be_looked_at_are_refused() {
    let network =
        Network::from_safetensors(&WeightsFile::random(&config(), 7).bytes(Precision::Single)).unwrap();
    let good = vec![[0.0, 1.0, 2.0]; 3];
    assert!(matches!(network.predict(&good, &[]), Err(Error::TooFewPoints { .. })));
    let error = network.predict(&[[0.0; 3], [f32::NAN; 3]], &good).unwrap_err();
    assert!(matches!(error, Error::NonFinite { count: 1, first: 1, .. }), "{error}");
    // Points all equal, and coordinates whose squares overflow.
    for odd in [good.clone(), vec![[3e30, -1e38, 0.0], [-3e38, 1e38, 1.0], [1.0; 3]]] {
        assert!(network.predict(&odd, &good).is_ok());
    }
}
