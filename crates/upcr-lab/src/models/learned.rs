//! Every network that learns: what training and evaluation ask of one. A new network is a variant here.

use std::path::Path;

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use nalgebra::{Matrix3, Vector3};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};
use upcr::net::NetworkConfig;
use upcr::{Error, Result, Rigid};

use super::attention::TransformerConfig;
use super::dcp::{Dcp, DcpConfig};
use super::dense::BatchStatistics;
use super::input::{CloudInput, Clouds};
use super::pointnetlk::{PointNetLk, PointNetLkConfig};
use super::prnet::{Prnet, PrnetConfig};
use super::tensor_file::{TensorFile, malformed};
use super::truth::Truth;
use super::upcr::{self as upcr_network, Upcr};
use super::weights;
use super::{Statistics, named};
use crate::random;

/// Metadata key under which the configurations of networks other than UPCR's stand.
const CONFIG_KEY: &str = "upcr.network";

/// What a network is made of. In files `kind` tells which it is, UPCR where nothing is told.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
#[allow(missing_docs)]
pub enum LearnedConfig {
    Upcr(NetworkConfig),
    Dcp(DcpConfig),
    Prnet(PrnetConfig),
    PointNetLk(PointNetLkConfig),
}

impl<'de> Deserialize<'de> for LearnedConfig {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        let mut fields = serde_json::Map::deserialize(deserializer)?;
        let kind = fields.remove("kind").unwrap_or_else(|| "upcr".into());
        let fields = serde_json::Value::Object(fields);
        let config = match kind.as_str() {
            Some("upcr") => serde_json::from_value(fields).map(Self::Upcr),
            Some("dcp") => serde_json::from_value(fields).map(Self::Dcp),
            Some("prnet") => serde_json::from_value(fields).map(Self::Prnet),
            Some("pointnetlk") => serde_json::from_value(fields).map(Self::PointNetLk),
            _ => {
                let known = "there are upcr, dcp, prnet and pointnetlk";
                return Err(D::Error::custom(format!("there is no network of kind {kind}; {known}")));
            }
        };
        config.map_err(D::Error::custom)
    }
}

impl Default for LearnedConfig {
    fn default() -> Self {
        Self::Upcr(NetworkConfig::default())
    }
}

/// The networks by their names.
pub const NETWORKS: [&str; 6] = ["upcr", "pointnetlk", "dcp-v1", "dcp-v2", "prnet", "prnet*"];

impl LearnedConfig {
    /// The network of that name as its paper has it.
    ///
    /// # Errors
    /// Where there is none.
    pub fn by_name(name: &str) -> Result<Self> {
        Ok(match name {
            "upcr" => Self::Upcr(NetworkConfig::default()),
            "pointnetlk" => Self::PointNetLk(PointNetLkConfig::default()),
            "dcp-v1" => Self::Dcp(DcpConfig::v1()),
            "dcp-v2" => Self::Dcp(DcpConfig::default()),
            "prnet" => Self::Prnet(PrnetConfig::default()),
            "prnet*" => Self::Prnet(PrnetConfig { keypoints: 1.0, ..PrnetConfig::default() }),
            other => {
                let reason = format!("there is no {other}; there are {}", NETWORKS.join(", "));
                return Err(Error::InvalidSetting { name: "network", reason });
            }
        })
    }

    /// The same in a quarter of the width: what two cores can train in minutes.
    #[must_use]
    pub fn narrow(&self) -> Self {
        let narrow = |config: &TransformerConfig| TransformerConfig {
            channels: config.channels / 4,
            inner: config.inner / 4,
            ..*config
        };
        match self {
            Self::Upcr(config) => Self::Upcr(NetworkConfig {
                widths: config.widths.iter().map(|width| width / 4).collect(),
                head: config.head.iter().map(|width| width / 2).collect(),
                ..config.clone()
            }),
            Self::Dcp(config) => Self::Dcp(DcpConfig {
                widths: config.widths.map(|width| width / 4),
                channels: config.channels / 4,
                pointer: config.pointer.as_ref().map(narrow),
                ..config.clone()
            }),
            Self::Prnet(config) => Self::Prnet(PrnetConfig {
                widths: config.widths.map(|width| width / 4),
                attention: narrow(&config.attention),
                ..config.clone()
            }),
            Self::PointNetLk(config) => Self::PointNetLk(PointNetLkConfig {
                widths: config.widths.map(|width| width / 4),
                ..config.clone()
            }),
        }
    }

    /// Refuses what makes no network.
    ///
    /// # Errors
    /// Where a number is out of its range.
    pub fn check(&self) -> Result<()> {
        match self {
            Self::Upcr(config) => config.check(),
            Self::Dcp(config) => config.check(),
            Self::Prnet(config) => config.check(),
            Self::PointNetLk(config) => config.check(),
        }
    }

    /// Random weights from a seed.
    ///
    /// # Errors
    /// Where the configuration is no network's.
    pub fn init(&self, seed: u64, device: &Device) -> Result<Learned> {
        self.check()?;
        let rng = &mut random::stream(seed, u64::MAX);
        Ok(match self {
            Self::Upcr(config) => Learned::Upcr(upcr_network::init(config, rng, device)?),
            Self::Dcp(config) => Learned::Dcp(config.init(rng, device)),
            Self::Prnet(config) => Learned::Prnet(config.init(rng, device)),
            Self::PointNetLk(config) => Learned::PointNetLk(config.init(rng, device)),
        })
    }

    /// The same, as its inputs see it: with so many neighbours, where the network has a choice.
    #[must_use]
    pub fn with_neighbors(&self, k: Option<usize>) -> Self {
        let mut config = self.clone();
        match (&mut config, k) {
            (Self::Upcr(config), Some(k)) => config.k = k,
            (Self::Dcp(config), Some(k)) => config.k = k,
            (Self::Prnet(config), Some(k)) => config.k = k,
            (Self::PointNetLk(_), _) | (_, None) => {}
        }
        config
    }

    /// What the network is given of a pair.
    ///
    /// # Errors
    /// Where the invariant feature cannot be computed.
    pub fn input(&self, source: Vec<[f32; 3]>, target: Vec<[f32; 3]>) -> Result<PairInput> {
        Ok(match self {
            Self::Upcr(config) => {
                let (source, target) = (CloudInput::new(&source, config)?, CloudInput::new(&target, config)?);
                PairInput::Clouds(Box::new((source, target)))
            }
            Self::Dcp(DcpConfig { k, .. }) | Self::Prnet(PrnetConfig { k, .. }) => {
                PairInput::Points(source, target, *k)
            }
            Self::PointNetLk(_) => PairInput::Points(source, target, 0),
        })
    }
}

/// A pair as a network is given it.
#[derive(Debug, Clone)]
pub enum PairInput {
    /// With neighbours and invariant features.
    Clouds(Box<(CloudInput, CloudInput)>),
    /// Coordinates alone, and how many neighbours the network is to look at.
    Points(Vec<[f32; 3]>, Vec<[f32; 3]>, usize),
}

/// Pairs that are seen together. Sources have one number of points, and targets have.
#[derive(Debug, Clone)]
pub struct Batch {
    inputs: BatchInputs,
    /// The true motions, of which supervised networks learn.
    truths: Vec<Rigid>,
}

#[derive(Debug, Clone)]
enum BatchInputs {
    Clouds(Clouds),
    /// Coordinates of all sources, one after the other, and of all targets; neighbours.
    Points([Vec<f32>; 2], usize),
}

impl Batch {
    /// Joins pairs, all made for one network, with their true motions.
    pub fn new(pairs: Vec<PairInput>, truths: Vec<Rigid>) -> Self {
        let mut clouds = Vec::new();
        let mut points = [Vec::new(), Vec::new()];
        let mut neighbors = 0;
        for pair in pairs {
            match pair {
                PairInput::Clouds(pair) => clouds.push(*pair),
                PairInput::Points(source, target, k) => {
                    neighbors = k;
                    points[0].extend_from_slice(source.as_flattened());
                    points[1].extend_from_slice(target.as_flattened());
                }
            }
        }
        // A cloud with fewer points than neighbours has fewer of these.
        let k = clouds.iter().map(|(source, target)| source.graph.k.max(target.graph.k)).max();
        let inputs = match k {
            Some(k) => BatchInputs::Clouds(Clouds::new(&clouds, k)),
            None => BatchInputs::Points(points, neighbors),
        };
        Self { inputs, truths }
    }

    /// The true motions.
    pub fn truths(&self) -> &[Rigid] {
        &self.truths
    }

    fn clouds(&self) -> Result<&Clouds> {
        match &self.inputs {
            BatchInputs::Clouds(clouds) => Ok(clouds),
            BatchInputs::Points(..) => Err(mismatch()),
        }
    }

    /// How many neighbours the network is to look at.
    fn neighbors(&self) -> Result<usize> {
        match self.inputs {
            BatchInputs::Points(_, k) => Ok(k),
            BatchInputs::Clouds(_) => Err(mismatch()),
        }
    }

    /// Sources and targets, `[pairs, points, 3]`.
    fn points(&self, device: &Device) -> Result<[Tensor<3>; 2]> {
        let BatchInputs::Points(points, _) = &self.inputs else { return Err(mismatch()) };
        let pairs = self.truths.len();
        Ok(points.each_ref().map(|values| {
            let count = values.len() / (3 * pairs.max(1));
            Tensor::from_data(TensorData::new(values.clone(), [pairs, count, 3]), device)
        }))
    }

    fn truth(&self, device: &Device) -> Truth {
        Truth::of(&self.truths, device)
    }
}

fn mismatch() -> Error {
    Error::InvalidSetting { name: "network", reason: "the batch was made for one of another kind".into() }
}

/// A network that learns.
#[derive(Module, Debug)]
#[allow(missing_docs, clippy::large_enum_variant)]
pub enum Learned {
    Upcr(Upcr),
    Dcp(Dcp),
    Prnet(Prnet),
    PointNetLk(PointNetLk),
}

impl Learned {
    /// What the network is made of.
    pub fn config(&self) -> LearnedConfig {
        match self {
            Self::Upcr(network) => LearnedConfig::Upcr(network.config.clone()),
            Self::Dcp(network) => LearnedConfig::Dcp(network.config.clone()),
            Self::Prnet(network) => LearnedConfig::Prnet(network.config.clone()),
            Self::PointNetLk(network) => LearnedConfig::PointNetLk(network.config.clone()),
        }
    }

    /// Where its weights are.
    pub fn device(&self) -> Device {
        self.devices().into_iter().next().unwrap_or_default()
    }

    /// The mean loss of a batch, which normalises itself, and its statistics. What is random comes from the seed.
    ///
    /// # Errors
    /// Where the batch was made for another network.
    pub fn learn(&self, batch: &Batch, seed: u64) -> Result<(Tensor<1>, BatchStatistics)> {
        let device = self.device();
        Ok(match self {
            Self::Upcr(network) => {
                let clouds = batch.clouds()?;
                let output = network.forward(clouds, Statistics::Batch);
                (output.loss(clouds).mean(), output.statistics)
            }
            Self::Dcp(network) => {
                let [source, target] = batch.points(&device)?;
                let output = network.seeing(batch.neighbors()?).forward(&source, &target, Statistics::Batch);
                (output.loss(&batch.truth(&device)), output.statistics)
            }
            Self::Prnet(network) => {
                let [source, target] = batch.points(&device)?;
                let network = network.seeing(batch.neighbors()?);
                network.learn(&source, &target, &batch.truth(&device), &mut random::stream(seed, 0))
            }
            Self::PointNetLk(network) => {
                let [source, target] = batch.points(&device)?;
                let output = network.forward(&source, &target, Statistics::Batch);
                (output.loss(&batch.truth(&device)), output.statistics)
            }
        })
    }

    /// The poses that the network gives, with its running statistics, and the mean loss.
    ///
    /// # Errors
    /// Where the batch was made for another network.
    pub fn judge(&self, batch: &Batch) -> Result<(Vec<Rigid>, f64)> {
        let network = self.valid();
        let device = network.device();
        let scalar = |loss: Tensor<1>| f64::from(loss.into_scalar::<f32>());
        Ok(match &network {
            Self::Upcr(network) => {
                let clouds = batch.clouds()?;
                let output = network.forward(clouds, Statistics::Running);
                (output.poses(clouds), scalar(output.loss(clouds).mean()))
            }
            Self::Dcp(network) => {
                let [source, target] = batch.points(&device)?;
                let network = network.seeing(batch.neighbors()?);
                let output = network.forward(&source, &target, Statistics::Running);
                (poses(&output.rotation, &output.translation), scalar(output.loss(&batch.truth(&device))))
            }
            Self::Prnet(network) => {
                let [source, target] = batch.points(&device)?;
                let network = network.seeing(batch.neighbors()?);
                let (rotation, translation) = network.forward(&source, &target);
                let loss = batch.truth(&device).distance(&rotation, &translation);
                (poses(&rotation, &translation), scalar(loss))
            }
            Self::PointNetLk(network) => {
                let [source, target] = batch.points(&device)?;
                let output = network.forward(&source, &target, Statistics::Running);
                let (rotation, translation) = output.pose_parts();
                (poses(&rotation, &translation), scalar(output.loss(&batch.truth(&device))))
            }
        })
    }

    /// The network with running statistics moved by `share` towards a batch's.
    #[must_use]
    pub fn observed(self, batch: &[[Tensor<1>; 2]], share: f64) -> Self {
        match self {
            Self::Upcr(network) => Self::Upcr(network.observed(batch, share)),
            Self::Dcp(network) => Self::Dcp(network.observed(batch, share)),
            Self::Prnet(network) => Self::Prnet(network.observed(batch, share)),
            Self::PointNetLk(network) => Self::PointNetLk(network.observed(batch, share)),
        }
    }

    /// The weights with their configuration.
    pub fn store(&self) -> TensorFile {
        if let Self::Upcr(network) = self {
            return weights::store(network);
        }
        let mut file = TensorFile { tensors: named::tensors(self), ..TensorFile::default() };
        // A configuration of numbers and names has no value that JSON lacks.
        let config = serde_json::to_string(&self.config()).unwrap_or_default();
        file.metadata.insert(CONFIG_KEY.into(), config);
        file.metadata.insert("upcr.version".into(), env!("CARGO_PKG_VERSION").into());
        file
    }

    /// The network that a file of the authors' holds, told by the names and sizes of its tensors. What these do not tell
    /// is as published: heads of attention, passes, key points.
    ///
    /// # Errors
    /// Where it is none of those known here, or a weight is missing or does not fit; `path` is what errors name.
    pub fn published(file: &TensorFile, path: &Path, device: &Device) -> Result<Self> {
        let outputs = |name: &str| {
            let shape = file.tensors.get(name).map(|tensor| tensor.shape.as_slice());
            shape.and_then(|shape| shape.first().copied()).ok_or_else(|| {
                malformed(path, format!("{name} is missing: this is none of the published networks"))
            })
        };
        let transformer = |prefix: &str, channels: usize| -> Result<TransformerConfig> {
            let layer =
                |block: usize| format!("{prefix}.model.encoder.layers.{block}.feed_forward.w_1.weight");
            let blocks =
                (0..file.tensors.len()).take_while(|&block| file.tensors.contains_key(&layer(block))).count();
            Ok(TransformerConfig { channels, heads: 4, blocks, inner: outputs(&layer(0))? })
        };
        let begins = |prefix: &str| file.tensors.keys().any(|name| name.starts_with(prefix));
        let maps = |prefix: &str| -> Result<[usize; 5]> {
            let mut widths = [0; 5];
            for (l, width) in widths.iter_mut().enumerate() {
                *width = outputs(&format!("{prefix}.conv{}.weight", l + 1))?;
            }
            Ok(widths)
        };
        let config = if begins("feature_model.") {
            let widths = maps("feature_model")?;
            LearnedConfig::PointNetLk(PointNetLkConfig { widths, ..PointNetLkConfig::default() })
        } else {
            let [a, b, c, d, channels] = maps("emb_nn")?;
            let widths = [a, b, c, d];
            if begins("temp_net.") {
                let attention = transformer("attention", channels)?;
                LearnedConfig::Prnet(PrnetConfig { widths, attention, ..PrnetConfig::default() })
            } else {
                let pointer = begins("pointer.").then(|| transformer("pointer", channels)).transpose()?;
                LearnedConfig::Dcp(DcpConfig { widths, channels, pointer, ..DcpConfig::default() })
            }
        };
        named::filled(config.init(0, device)?, file, path, str::to_owned)
    }

    /// The pose that lays `source` on `target`.
    ///
    /// # Errors
    /// Where the invariant feature cannot be computed.
    pub fn predict(&self, source: Vec<[f32; 3]>, target: Vec<[f32; 3]>) -> Result<Rigid> {
        let input = self.config().input(source, target)?;
        let (poses, _) = self.judge(&Batch::new(vec![input], vec![Rigid::identity()]))?;
        Ok(poses.first().copied().unwrap_or_else(Rigid::identity))
    }

    /// What of a pair's pose is the network's work, without the way from its features to the pose: to be timed.
    ///
    /// # Errors
    /// As [`Self::predict`].
    pub fn embed(&self, source: Vec<[f32; 3]>, target: Vec<[f32; 3]>) -> Result<()> {
        let network = self.valid();
        let batch = Batch::new(vec![self.config().input(source, target)?], vec![Rigid::identity()]);
        match &network {
            Self::Upcr(network) => drop(network.forward(batch.clouds()?, Statistics::Running)),
            Self::Dcp(network) => {
                let [source, target] = batch.points(&network.devices()[0])?;
                drop(network.features(&source, &target, Statistics::Running, &mut Vec::new()));
            }
            Self::Prnet(network) => {
                let [source, target] = batch.points(&network.devices()[0])?;
                for _ in 0..network.config.passes {
                    drop(network.features(&source, &target, Statistics::Running, &mut Vec::new()));
                }
            }
            Self::PointNetLk(network) => {
                let [source, target] = batch.points(&network.devices()[0])?;
                network.features(&source, &target);
            }
        }
        Ok(())
    }

    /// The network that a file holds.
    ///
    /// # Errors
    /// Where its configuration or a weight is missing or does not fit; `path` is what errors name.
    pub fn restore(file: &TensorFile, path: &Path, device: &Device) -> Result<Self> {
        let Some(config) = file.metadata.get(CONFIG_KEY) else {
            return weights::restore(file, path, device).map(Self::Upcr);
        };
        let config: LearnedConfig =
            serde_json::from_str(config).map_err(|e| malformed(path, format!("{CONFIG_KEY}: {e}")))?;
        named::filled(config.init(0, device)?, file, path, str::to_owned)
    }
}

/// Poses from rotations `[pairs, 3, 3]` and translations `[pairs, 3]`.
fn poses(rotation: &Tensor<3>, translation: &Tensor<2>) -> Vec<Rigid> {
    let values = |data: TensorData| data.iter::<f32>().map(f64::from).collect::<Vec<f64>>();
    let (rotations, translations) =
        (values(rotation.clone().into_data()), values(translation.clone().into_data()));
    let pose = |(rotation, translation): (&[f64], &[f64])| Rigid {
        rotation: Matrix3::from_row_slice(rotation),
        translation: Vector3::from_column_slice(translation),
    };
    rotations.chunks_exact(9).zip(translations.chunks_exact(3)).map(pose).collect()
}
