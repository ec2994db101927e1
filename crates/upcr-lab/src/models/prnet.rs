//! PRNet (Wang & Solomon, NeurIPS 2019): the pose of the key points of two partial clouds, again and again.

use burn::module::Module;
use burn::tensor::activation::{relu, softmax};
use burn::tensor::{Device, IndexingUpdateOp, Tensor, TensorData};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use upcr::{Error, Result};

use super::attention::{Transformer, TransformerConfig};
use super::dcp::{likeness, pose_of_matches};
use super::dense::{BatchNorm, BatchStatistics, Dense};
use super::dgcnn::{DEFAULT_K, DEFAULT_WIDTHS, Dgcnn, Edges, NEGATIVE_SLOPE, check_k};
use super::layers::{Init, Statistics, check_channels};
use super::truth::Truth;

/// Bounds of the temperature's inverse.
const SHARPEST: f64 = 100.0;
/// How much less each pass counts than the one before it.
const DISCOUNT: f64 = 0.9;
/// Weights of the losses beside that of the pose.
const CYCLE_WEIGHT: f64 = 0.1;
const ALIGNMENT_WEIGHT: f64 = 0.1;
/// Channels inside of the temperature's network.
const INNER: usize = 128;

/// A PRNet. The default is the paper's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PrnetConfig {
    /// Neighbours of a point, itself included.
    pub k: usize,
    /// Channels after each of the point feature's first four layers.
    pub widths: [usize; 4],
    /// The transformer, and channels of a point's feature.
    pub attention: TransformerConfig,
    /// Share of each cloud's points that are matched; 1 in PRNet*.
    pub keypoints: f64,
    /// Passes over a pair.
    pub passes: usize,
    /// How a point chooses its partner.
    pub sampler: Sampler,
}

/// How a key point chooses its partner.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Sampler {
    /// One of the other cloud's, at random while learning, the most alike in use; its gradient is that of the mean.
    #[default]
    GumbelSoftmax,
    /// The mean of all, weighted by likeness.
    Softmax,
}

impl Default for PrnetConfig {
    fn default() -> Self {
        let attention = TransformerConfig { channels: 512, heads: 4, blocks: 1, inner: 1024 };
        Self {
            k: DEFAULT_K,
            widths: DEFAULT_WIDTHS,
            attention,
            keypoints: 0.5,
            passes: 3,
            sampler: Sampler::default(),
        }
    }
}

impl PrnetConfig {
    /// Refuses what makes no network.
    ///
    /// # Errors
    /// Where a number is out of its range.
    pub fn check(&self) -> Result<()> {
        check_k(self.k)?;
        self.widths.into_iter().try_for_each(check_channels)?;
        self.attention.check(self.attention.channels)?;
        let refused = |name, reason: &str| Err(Error::InvalidSetting { name, reason: reason.into() });
        if !(self.keypoints > 0.0 && self.keypoints <= 1.0) {
            return refused("keypoints", "must be a share above 0, at most 1");
        }
        if !(1..=100).contains(&self.passes) {
            return refused("passes", "must be 1 to 100");
        }
        Ok(())
    }

    /// Random weights.
    pub fn init(&self, rng: &mut impl Rng, device: &Device) -> Prnet {
        let mut init = Init::new(rng, device);
        Prnet {
            emb_nn: Dgcnn::init(Edges::Dynamic, self.widths, self.attention.channels, &mut init),
            attention: Transformer::init(&self.attention, NEGATIVE_SLOPE, &mut init),
            temp_net: TemperatureNet::init(self.attention.channels, &mut init),
            config: self.clone(),
        }
    }
}

/// The network. Fields are named as in the published files.
#[derive(Module, Debug)]
pub struct Prnet {
    /// Features of points.
    pub emb_nn: Dgcnn,
    /// What they gain from the other cloud.
    pub attention: Transformer,
    /// How sharply points choose their partners.
    pub temp_net: TemperatureNet,
    /// What the network is made of.
    #[module(skip)]
    pub config: PrnetConfig,
}

/// A step of PRNet over a batch of pairs.
#[derive(Debug, Clone)]
pub struct PrnetOutput {
    /// The most distinctive points of the sources, `[pairs, keypoints, 3]`.
    pub source_keypoints: Tensor<3>,
    /// Those of the targets.
    pub target_keypoints: Tensor<3>,
    /// Their features, `[pairs, keypoints, channels]`.
    pub source: Tensor<3>,
    /// The same of the targets.
    pub target: Tensor<3>,
    /// By which likenesses are multiplied, `[pairs, 1]`.
    pub sharpness: Tensor<2>,
    /// How far apart the clouds' mean features are, `[pairs, channels]`.
    pub disparity: Tensor<2>,
    /// From source to target, `[pairs, 3, 3]`.
    pub rotation: Tensor<3>,
    /// From source to target, `[pairs, 3]`.
    pub translation: Tensor<2>,
    /// From target to source.
    pub rotation_back: Tensor<3>,
    /// From target to source.
    pub translation_back: Tensor<2>,
    /// Of the norms, where the batch's normalised.
    pub statistics: BatchStatistics,
}

impl Prnet {
    /// The same network with `k` neighbours: among fewer points, fewer reach as far.
    #[must_use]
    pub fn seeing(&self, k: usize) -> Self {
        Self { config: PrnetConfig { k, ..self.config.clone() }, ..self.clone() }
    }

    /// Features of the points of sources and targets, each `[pairs, points, channels]`.
    pub(super) fn features(
        &self,
        source_points: &Tensor<3>,
        target_points: &Tensor<3>,
        statistics: Statistics,
        found: &mut BatchStatistics,
    ) -> [Tensor<3>; 2] {
        let k = self.config.k;
        let [source, target] = self.emb_nn.of_pairs(source_points, target_points, k, statistics, found);
        let [source_gain, target_gain] = self.attention.forward(&source, &target);
        [source + source_gain, target + target_gain]
    }

    /// One pass, from `[pairs, points, 3]` of sources and targets. Where partners are drawn, `random` draws them; without
    /// it they are the most alike.
    pub fn pass(
        &self,
        source_points: &Tensor<3>,
        target_points: &Tensor<3>,
        statistics: Statistics,
        mut random: Option<&mut ChaCha8Rng>,
    ) -> PrnetOutput {
        let mut found = Vec::new();
        let [pairs, ..] = source_points.dims();
        let [source, target] = self.features(source_points, target_points, statistics, &mut found);
        let (sharpness, disparity) = self.temp_net.forward(&source, &target, statistics, &mut found);
        let (source_keypoints, source) = self.keypoints(source_points, source);
        let (target_keypoints, target) = self.keypoints(target_points, target);
        let alike = likeness(source.clone(), target.clone());
        let sharp = sharpness.clone().reshape([pairs, 1, 1]);
        let mut pose = |from: &Tensor<3>, to: &Tensor<3>, alike: Tensor<3>| {
            let shares = self.shares(alike, sharp.clone(), random.as_deref_mut());
            pose_of_matches(from.clone(), shares.matmul(to.clone()))
        };
        let (rotation, translation) = pose(&source_keypoints, &target_keypoints, alike.clone());
        let (rotation_back, translation_back) = pose(&target_keypoints, &source_keypoints, alike.transpose());
        PrnetOutput {
            source_keypoints,
            target_keypoints,
            source,
            target,
            sharpness,
            disparity,
            rotation,
            translation,
            rotation_back,
            translation_back,
            statistics: found,
        }
    }

    /// The share of each target's point in the partner of each source's, `[pairs, points, points]`.
    fn shares(&self, alike: Tensor<3>, sharp: Tensor<3>, random: Option<&mut ChaCha8Rng>) -> Tensor<3> {
        match self.config.sampler {
            Sampler::Softmax => softmax(alike * sharp, 2),
            Sampler::GumbelSoftmax => {
                let noisy = match random {
                    Some(rng) => alike.clone() + gumbel(alike.dims(), rng, &alike.device()),
                    None => alike,
                };
                let soft = softmax(noisy / sharp, 2);
                let [pairs, points, others] = soft.dims();
                let chosen = soft.clone().detach().argmax(2);
                let ones = Tensor::<3>::ones([pairs, points, 1], &soft.device());
                let hard = Tensor::<3>::zeros([pairs, points, others], &soft.device()).scatter(
                    2,
                    chosen,
                    ones,
                    IndexingUpdateOp::Add,
                );
                // The value of the choice, the gradient of the mean.
                hard + soft.clone() - soft.detach()
            }
        }
    }

    /// All passes, each on what the one before it moved: rotations `[pairs, 3, 3]` and translations `[pairs, 3]`.
    pub fn forward(&self, source: &Tensor<3>, target: &Tensor<3>) -> (Tensor<3>, Tensor<2>) {
        let mut journey = Journey::new(source);
        for _ in 0..self.config.passes {
            let output = self.pass(&journey.source, target, Statistics::Running, None);
            journey.step(&output.rotation, &output.translation);
        }
        (journey.rotation, journey.translation)
    }

    /// The loss over all passes, later ones counting less, and the batch's statistics of the first: how far each pass'
    /// pose is from what is left of the true one, whether there and back is nowhere, and how far apart the clouds'
    /// features are.
    pub fn learn(
        &self,
        source: &Tensor<3>,
        target: &Tensor<3>,
        truth: &Truth,
        rng: &mut ChaCha8Rng,
    ) -> (Tensor<1>, BatchStatistics) {
        let [pairs, ..] = source.dims();
        let mut journey = Journey::new(source);
        let mut loss = Tensor::zeros([1], &source.device());
        let mut statistics = None;
        for pass in 0..self.config.passes {
            let output = self.pass(&journey.source, target, Statistics::Batch, Some(rng));
            let left = journey.left(truth);
            let there_and_back = output.rotation_back.clone().matmul(output.rotation.clone());
            let back = output.rotation_back.clone().matmul(output.translation.clone().reshape([pairs, 3, 1]));
            let nowhere = Truth::identity(pairs, &source.device());
            let cycle =
                nowhere.distance(&there_and_back, &(back.reshape([pairs, 3]) + output.translation_back));
            let step = left.distance(&output.rotation, &output.translation)
                + cycle * CYCLE_WEIGHT
                + output.disparity.mean() * ALIGNMENT_WEIGHT;
            loss = loss + step * DISCOUNT.powi(pass as i32);
            journey.step(&output.rotation.detach(), &output.translation.detach());
            statistics.get_or_insert(output.statistics);
        }
        (loss, statistics.unwrap_or_default())
    }

    /// The points whose features are longest, with these.
    fn keypoints(&self, points: &Tensor<3>, features: Tensor<3>) -> (Tensor<3>, Tensor<3>) {
        let [_, count, channels] = features.dims();
        // A pose needs three.
        let wanted = ((self.config.keypoints * count as f64).round() as usize).max(3).min(count);
        if wanted == count {
            return (points.clone(), features);
        }
        let length_sq = features.clone().detach().square().sum_dim(2);
        let (_, chosen) = length_sq.topk_with_indices(wanted, 1);
        (
            points.clone().gather(1, chosen.clone().repeat_dim(2, 3)),
            features.gather(1, chosen.repeat_dim(2, channels)),
        )
    }

    /// The network with running statistics moved by `share` towards a batch's.
    #[must_use]
    pub fn observed(self, batch: &[[Tensor<1>; 2]], share: f64) -> Self {
        let mut batch = batch.iter();
        let emb_nn = self.emb_nn.observed(&mut batch, share);
        Self { emb_nn, temp_net: self.temp_net.observed(&mut batch, share), ..self }
    }
}

/// A source on its way, and the motion so far.
struct Journey {
    source: Tensor<3>,
    rotation: Tensor<3>,
    translation: Tensor<2>,
}

impl Journey {
    fn new(source: &Tensor<3>) -> Self {
        let Truth { rotation, translation } = Truth::identity(source.dims()[0], &source.device());
        Self { source: source.clone(), rotation, translation }
    }

    fn step(&mut self, rotation: &Tensor<3>, translation: &Tensor<2>) {
        let [pairs, ..] = rotation.dims();
        let moved = |points: Tensor<3>| {
            points.matmul(rotation.clone().transpose()) + translation.clone().reshape([pairs, 1, 3])
        };
        self.source = moved(self.source.clone());
        self.rotation = rotation.clone().matmul(self.rotation.clone());
        self.translation = moved(self.translation.clone().reshape([pairs, 1, 3])).reshape([pairs, 3]);
    }

    /// What is left of the true motion: R' = R·Rₛᵀ, t' = t − R'·tₛ.
    fn left(&self, truth: &Truth) -> Truth {
        let [pairs, ..] = self.rotation.dims();
        let rotation = truth.rotation.clone().matmul(self.rotation.clone().transpose());
        let so_far = rotation.clone().matmul(self.translation.clone().reshape([pairs, 3, 1]));
        Truth { translation: truth.translation.clone() - so_far.reshape([pairs, 3]), rotation }
    }
}

/// Gumbel-distributed noise.
fn gumbel(shape: [usize; 3], rng: &mut ChaCha8Rng, device: &Device) -> Tensor<3> {
    let mut draw = || {
        let u: f32 = rng.random_range(f32::MIN_POSITIVE..1.0);
        -(-u.ln()).max(f32::MIN_POSITIVE).ln()
    };
    let values = (0..shape.iter().product()).map(|_| draw()).collect();
    Tensor::from_data(TensorData::new::<f32, _>(values, shape), device)
}

/// From how far apart two clouds' mean features are to how sharply their points choose.
#[derive(Module, Debug)]
pub struct TemperatureNet {
    /// Maps, norms and rectifiers, one after the other.
    pub nn: Vec<Layer>,
}

/// A layer of the temperature's network.
#[derive(Module, Debug)]
#[allow(missing_docs)]
pub enum Layer {
    Map(Dense),
    Norm(BatchNorm),
    Rectifier(Rectifier),
}

/// Zero below zero.
#[derive(Module, Debug)]
pub struct Rectifier;

impl TemperatureNet {
    fn init(channels: usize, init: &mut Init<impl Rng>) -> Self {
        let mut nn = Vec::new();
        for inputs in [channels, INNER, INNER] {
            nn.push(Layer::Map(Dense::init(inputs, INNER, init)));
            nn.push(Layer::Norm(BatchNorm::init(INNER, init)));
            nn.push(Layer::Rectifier(Rectifier));
        }
        nn.push(Layer::Map(Dense::init(INNER, 1, init)));
        nn.push(Layer::Rectifier(Rectifier));
        Self { nn }
    }

    /// The sharpness `[pairs, 1]`, and the disparity `[pairs, channels]` that it comes from.
    fn forward(
        &self,
        source: &Tensor<3>,
        target: &Tensor<3>,
        statistics: Statistics,
        found: &mut BatchStatistics,
    ) -> (Tensor<2>, Tensor<2>) {
        let [pairs, _, channels] = source.dims();
        let mean = |features: &Tensor<3>| features.clone().mean_dim(1).reshape([pairs, channels]);
        let disparity = (mean(source) - mean(target)).abs();
        let value = self.nn.iter().fold(disparity.clone(), |x, layer| match layer {
            Layer::Map(map) => map.forward(x),
            Layer::Norm(norm) => norm.forward(x, statistics, found),
            Layer::Rectifier(_) => relu(x),
        });
        (value.clamp(1.0 / SHARPEST, SHARPEST), disparity)
    }

    fn observed<'a>(self, batch: &mut impl Iterator<Item = &'a [Tensor<1>; 2]>, share: f64) -> Self {
        let observe = |layer| match layer {
            Layer::Norm(norm) => Layer::Norm(norm.observed(batch, share)),
            other => other,
        };
        Self { nn: self.nn.into_iter().map(observe).collect() }
    }
}
