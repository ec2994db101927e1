//! What the published networks have in common: gradients against finite differences, and files.

use std::path::Path;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Device, Gradients, Tensor, TensorData};
use rand::Rng;

use super::attention::TransformerConfig;
use super::dcp::{DcpConfig, pose_of_matches};
use super::pointnetlk::PointNetLkConfig;
use super::prnet::{PrnetConfig, Sampler};
use super::tensor_file::{StoredTensor, TensorFile};
use super::{Statistics, named, procrustes};
use crate::random;

const TRANSFORMER: TransformerConfig = TransformerConfig { channels: 16, heads: 2, blocks: 1, inner: 24 };

fn device() -> Device {
    Device::flex().autodiff()
}

fn uniform<const D: usize>(shape: [usize; D], seed: u64, device: &Device) -> Tensor<D> {
    let mut rng = random::stream(seed, 0);
    let values = (0..shape.iter().product()).map(|_| rng.random_range(-1.0_f32..1.0)).collect();
    Tensor::from_data(TensorData::new::<f32, _>(values, shape), device)
}

fn scalar(loss: Tensor<1>) -> f64 {
    f64::from(loss.into_scalar::<f32>())
}

/// The gradient's length by tensor, and the tensor's number.
struct Lengths<'a> {
    gradients: &'a Gradients,
    found: Vec<(usize, f64)>,
    seen: usize,
}

impl ModuleVisitor for Lengths<'_> {
    fn visit_float<const D: usize>(&mut self, parameter: &Param<Tensor<D>>) {
        if let Some(gradient) = parameter.val().grad(self.gradients) {
            let length = scalar(gradient.square().sum()).sqrt();
            self.found.push((self.seen, length));
        }
        self.seen += 1;
    }
}

/// Moves one tensor by `step` along its gradient's direction.
struct Shift<'a> {
    gradients: &'a Gradients,
    tensor: usize,
    step: f64,
    seen: usize,
}

impl ModuleMapper for Shift<'_> {
    fn map_float<const D: usize>(&mut self, parameter: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let chosen = self.seen == self.tensor;
        self.seen += 1;
        match parameter.val().grad(self.gradients) {
            Some(gradient) if chosen => {
                let step = self.step / scalar(gradient.clone().square().sum()).sqrt();
                parameter.map(|value| Tensor::from_inner(value.inner() + gradient * step).require_grad())
            }
            _ => parameter,
        }
    }
}

/// How much a loss changes for a slope: little beside its curvature, much beside rounding.
const CHANGE: f64 = 2e-3;

/// Along its own direction a gradient is the slope: of every tensor of a network.
fn assert_gradients<M: Module>(network: &M, loss: impl Fn(&M) -> Tensor<1>) {
    let gradients = loss(network).backward();
    let mut lengths = Lengths { gradients: &gradients, found: Vec::new(), seen: 0 };
    network.visit(&mut lengths);
    let longest = lengths.found.iter().map(|(_, length)| *length).fold(0.0, f64::max);
    assert!(longest > 0.0);
    let mut checked = 0;
    for (tensor, length) in lengths.found {
        // Those that change nothing (a shift before a norm) have rounding errors for gradients.
        if length < 1e-3 * longest {
            continue;
        }
        let at = |step: f64| {
            let mut shift = Shift { gradients: &gradients, tensor, step, seen: 0 };
            scalar(loss(&network.clone().map(&mut shift)))
        };
        let step = CHANGE / length;
        let slope = (at(step) - at(-step)) / (2.0 * step);
        // Maxima and rectifiers change branches on the way.
        assert!((slope - length).abs() < 0.06 * length, "tensor {tensor}: {slope} is not {length}");
        checked += 1;
    }
    assert!(checked > 3, "only {checked} of {} tensors have a gradient", lengths.seen);
}

/// How far rotations and translations are from some others: every entry counts.
fn pose_loss(rotation: Tensor<3>, translation: Tensor<2>) -> Tensor<1> {
    let device = rotation.device();
    let direction = uniform(rotation.dims(), 5, &device);
    let shift = uniform(translation.dims(), 6, &device);
    (rotation * direction).sum() + (translation * shift).sum()
}

fn clouds(pairs: usize, points: usize) -> [Tensor<3>; 2] {
    [1, 2].map(|seed| uniform([pairs, points, 3], seed, &device()))
}

#[test]
fn gradients_of_dcp_are_slopes() {
    let [source, target] = clouds(2, 24);
    for pointer in [None, Some(TRANSFORMER)] {
        let network = DcpConfig { channels: 16, pointer, ..DcpConfig::default() }
            .init(&mut random::stream(1, 0), &device());
        assert_gradients(&network, |network| {
            let output = network.forward(&source, &target, Statistics::Batch);
            pose_loss(output.rotation, output.translation)
        });
    }
}

#[test]
fn gradients_of_prnet_are_slopes() {
    // So few points that all are neighbours: which ones are has no gradient.
    let [source, target] = clouds(6, 18);
    let config = PrnetConfig {
        attention: TRANSFORMER,
        keypoints: 1.0,
        passes: 1,
        sampler: Sampler::Softmax,
        ..PrnetConfig::default()
    };
    let network = config.init(&mut random::stream(1, 0), &device());
    // Sharp enough for the rotations to be determined, and within the bounds, where it has a gradient.
    let mut file = TensorFile { tensors: named::tensors(&network), ..TensorFile::default() };
    file.tensors.insert("temp_net.nn.9.bias".into(), StoredTensor::from_f32(&[20.0], &[1]));
    let network = named::filled(network, &file, Path::new("file"), str::to_owned).unwrap();
    assert_gradients(&network, |network| {
        let output = network.pass(&source, &target, Statistics::Batch, None);
        pose_loss(output.rotation, output.translation) + output.disparity.sum()
    });
}

#[test]
fn gradients_of_pointnetlk_are_slopes() {
    let [source, target] = clouds(2, 60);
    let config = PointNetLkConfig { widths: [16, 16, 16, 32, 128], steps: 1 };
    let network = config.init(&mut random::stream(1, 0), &device());
    let statistics = network.forward(&source, &target, Statistics::Batch).statistics;
    let network = network.observed(&statistics, 1.0);
    assert_gradients(&network, |network| {
        let output = network.forward(&source, &target, Statistics::Running);
        let (rotation, translation) = output.pose_parts();
        pose_loss(rotation, translation) + output.residual.square().sum()
    });
}

#[test]
fn rotations_of_matches_have_gradients_where_decompositions_have_none() {
    // Matrices with equal singular values, and one whose best orthogonal matrix is a reflection.
    let matrices: [[f32; 9]; 4] = [
        [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        [2.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0],
        [3.0, 0.2, 0.0, -0.1, 2.0, 0.3, 0.0, 0.4, -1.0],
        [0.7, -0.3, 0.2, 0.5, 0.1, 0.6, -0.2, 0.8, 0.4],
    ];
    let at = |values: &[f32]| {
        let m = Tensor::<3>::from_data(TensorData::new(values.to_vec(), [1, 3, 3]), &device());
        m.require_grad()
    };
    let loss = |m: Tensor<3>| (procrustes::rotation(m) * uniform([1, 3, 3], 3, &device())).sum();
    for values in matrices {
        let m = at(&values);
        let r: Vec<f32> = procrustes::rotation(m.clone()).into_data().iter::<f32>().collect();
        let r = nalgebra::Matrix3::from_row_slice(&r);
        assert!(
            (r.determinant() - 1.0).abs() < 1e-5
                && (r * r.transpose() - nalgebra::Matrix3::identity()).amax() < 1e-5
        );
        let gradients = loss(m.clone()).backward();
        let gradient: Vec<f32> = m.grad(&gradients).unwrap().into_data().iter::<f32>().collect();
        for entry in 0..9 {
            let moved = |step: f32| {
                let mut values = values;
                values[entry] += step;
                scalar(loss(at(&values)))
            };
            let slope = (moved(1e-2) - moved(-1e-2)) / 2e-2;
            assert!(
                (slope - f64::from(gradient[entry])).abs() < 2e-3,
                "{values:?} {entry}: {slope} {}",
                gradient[entry]
            );
        }
    }
}

#[test]
fn matches_without_shape_have_finite_gradients() {
    let line: Vec<f32> = (0..30).flat_map(|i| [i as f32 * 0.1, 0.0, 0.0]).collect();
    for values in [vec![0.0; 90], line] {
        let points = Tensor::<3>::from_data(TensorData::new(values, [1, 30, 3]), &device()).require_grad();
        let (rotation, translation) = pose_of_matches(points.clone(), points.clone());
        let gradients = pose_loss(rotation, translation).backward();
        let gradient = points.grad(&gradients).unwrap();
        assert!(gradient.into_data().iter::<f32>().all(f32::is_finite));
    }
}

#[test]
fn networks_come_back_from_their_files() {
    let config = PrnetConfig {
        attention: TRANSFORMER,
        keypoints: 0.5,
        passes: 1,
        sampler: Sampler::Softmax,
        ..PrnetConfig::default()
    };
    let network = config.init(&mut random::stream(1, 0), &Device::flex());
    let mut file = TensorFile { tensors: named::tensors(&network), ..TensorFile::default() };
    for name in [
        "emb_nn.conv2.weight",
        "temp_net.nn.4.running_var",
        "attention.model.decoder.layers.0.src_attn.linears.3.bias",
    ] {
        assert!(file.tensors.contains_key(name), "{name}");
    }
    let other = || config.init(&mut random::stream(2, 0), &Device::flex());
    let again = named::filled(other(), &file, Path::new("file"), str::to_owned).unwrap();
    assert_eq!(named::tensors(&again), file.tensors);
    // Sizes as of convolutions.
    if let Some(conv) = file.tensors.get_mut("emb_nn.conv2.weight") {
        conv.shape.extend([1, 1]);
    }
    assert!(named::filled(other(), &file, Path::new("file"), str::to_owned).is_ok());
    file.tensors.remove("emb_nn.bn3.bias");
    let error = named::filled(other(), &file, Path::new("file"), str::to_owned).unwrap_err();
    assert!(error.to_string().contains("emb_nn.bn3.bias is missing"), "{error}");
}
