//! The transformer of DCP and PRNet (Vaswani et al., 2017): each cloud's features in the light of the other's.

use burn::module::{Module, Param};
use burn::tensor::Tensor;
use rand::Rng;
use serde::{Deserialize, Serialize};
use upcr::{Error, Result};

use super::dense::Dense;
use super::layers::{Init, check_channels};
use crate::ops;

/// Sizes of a transformer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TransformerConfig {
    /// Channels of a point.
    pub channels: usize,
    /// Heads of an attention.
    pub heads: usize,
    /// Layers of the encoder and of the decoder.
    pub blocks: usize,
    /// Channels inside of a feed-forward layer.
    pub inner: usize,
}

impl TransformerConfig {
    /// Refuses what makes no transformer of features with so many channels.
    ///
    /// # Errors
    /// Where a number is out of its range.
    pub fn check(&self, channels: usize) -> Result<()> {
        check_channels(self.channels)?;
        check_channels(self.inner)?;
        let refused = |name, reason: &str| Err(Error::InvalidSetting { name, reason: reason.into() });
        if self.channels != channels {
            return refused("channels", "must be the same of the features and of the transformer");
        }
        if self.heads == 0 || !self.channels.is_multiple_of(self.heads) {
            return refused("heads", "must divide the channels");
        }
        if !(1..=64).contains(&self.blocks) {
            return refused("blocks", "must be 1 to 64");
        }
        Ok(())
    }
}

/// Encoder and decoder. Fields are named as in the published files.
#[derive(Module, Debug)]
pub struct Transformer {
    /// Both.
    pub model: EncoderDecoder,
}

impl Transformer {
    /// `negative_slope` is that of the rectifiers for negative values.
    pub(super) fn init(config: &TransformerConfig, negative_slope: f32, init: &mut Init<impl Rng>) -> Self {
        let norm = |init: &mut Init<_>| LayerNorm::init(config.channels, init);
        let encoder = Encoder {
            layers: (0..config.blocks).map(|_| EncoderLayer::init(config, negative_slope, init)).collect(),
            norm: norm(init),
        };
        let decoder = Decoder {
            layers: (0..config.blocks).map(|_| DecoderLayer::init(config, negative_slope, init)).collect(),
            norm: norm(init),
        };
        Self { model: EncoderDecoder { encoder, decoder } }
    }

    /// What the source's features `[batch, points, channels]` gain from the target's, and the other way round.
    pub fn forward(&self, source: &Tensor<3>, target: &Tensor<3>) -> [Tensor<3>; 2] {
        let EncoderDecoder { encoder, decoder } = &self.model;
        let seen_from =
            |from: &Tensor<3>, to: &Tensor<3>| decoder.forward(to.clone(), &encoder.forward(from.clone()));
        [seen_from(target, source), seen_from(source, target)]
    }
}

/// A transformer's two halves.
#[derive(Module, Debug)]
pub struct EncoderDecoder {
    /// Reads one cloud.
    pub encoder: Encoder,
    /// Reads the other in its light.
    pub decoder: Decoder,
}

/// Layers of self-attention.
#[derive(Module, Debug)]
pub struct Encoder {
    /// From the first to the last.
    pub layers: Vec<EncoderLayer>,
    /// After them.
    pub norm: LayerNorm,
}

impl Encoder {
    fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        self.norm.forward(self.layers.iter().fold(x, |x, layer| layer.forward(x)))
    }
}

/// Layers of self-attention and attention to the encoder's cloud.
#[derive(Module, Debug)]
pub struct Decoder {
    /// From the first to the last.
    pub layers: Vec<DecoderLayer>,
    /// After them.
    pub norm: LayerNorm,
}

impl Decoder {
    fn forward(&self, x: Tensor<3>, memory: &Tensor<3>) -> Tensor<3> {
        self.norm.forward(self.layers.iter().fold(x, |x, layer| layer.forward(x, memory)))
    }
}

/// Self-attention, then a map of each point.
#[derive(Module, Debug)]
pub struct EncoderLayer {
    /// Attention among the points.
    pub self_attn: Attention,
    /// The map of each point.
    pub feed_forward: FeedForward,
    /// Around each of them.
    pub sublayer: Vec<Residual>,
}

impl EncoderLayer {
    fn init(config: &TransformerConfig, negative_slope: f32, init: &mut Init<impl Rng>) -> Self {
        Self {
            self_attn: Attention::init(config, init),
            feed_forward: FeedForward::init(config, negative_slope, init),
            sublayer: (0..2).map(|_| Residual::init(config, init)).collect(),
        }
    }

    fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        let x = self.sublayer[0].around(x, |x| self.self_attn.forward(x.clone(), &x));
        self.sublayer[1].around(x, |x| self.feed_forward.forward(x))
    }
}

/// Self-attention, attention to the other cloud, then a map of each point.
#[derive(Module, Debug)]
pub struct DecoderLayer {
    /// Attention among the points.
    pub self_attn: Attention,
    /// Attention to the encoder's.
    pub src_attn: Attention,
    /// The map of each point.
    pub feed_forward: FeedForward,
    /// Around each of them.
    pub sublayer: Vec<Residual>,
}

impl DecoderLayer {
    fn init(config: &TransformerConfig, negative_slope: f32, init: &mut Init<impl Rng>) -> Self {
        Self {
            self_attn: Attention::init(config, init),
            src_attn: Attention::init(config, init),
            feed_forward: FeedForward::init(config, negative_slope, init),
            sublayer: (0..3).map(|_| Residual::init(config, init)).collect(),
        }
    }

    fn forward(&self, x: Tensor<3>, memory: &Tensor<3>) -> Tensor<3> {
        let x = self.sublayer[0].around(x, |x| self.self_attn.forward(x.clone(), &x));
        let x = self.sublayer[1].around(x, |x| self.src_attn.forward(x, memory));
        self.sublayer[2].around(x, |x| self.feed_forward.forward(x))
    }
}

/// What a layer of the normalised features adds to them.
#[derive(Module, Debug)]
pub struct Residual {
    /// Before the layer.
    pub norm: LayerNorm,
}

impl Residual {
    fn init(config: &TransformerConfig, init: &mut Init<impl Rng>) -> Self {
        Self { norm: LayerNorm::init(config.channels, init) }
    }

    fn around(&self, x: Tensor<3>, layer: impl FnOnce(Tensor<3>) -> Tensor<3>) -> Tensor<3> {
        x.clone() + layer(self.norm.forward(x))
    }
}

/// Each point's channels about their mean, by their (unbiased) standard deviation.
#[derive(Module, Debug)]
pub struct LayerNorm {
    /// Scale, `[channels]`.
    pub a_2: Param<Tensor<1>>,
    /// Shift, `[channels]`.
    pub b_2: Param<Tensor<1>>,
}

impl LayerNorm {
    fn init(channels: usize, init: &mut Init<impl Rng>) -> Self {
        Self { a_2: init.filled(1.0, channels), b_2: init.filled(0.0, channels) }
    }

    fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        let [batch, points, channels] = x.dims();
        let rows = x.reshape([batch * points, channels]);
        ops::layer_norm(rows, self.a_2.val(), self.b_2.val()).reshape([batch, points, channels])
    }
}

/// Scaled dot-product attention of several heads.
#[derive(Module, Debug)]
pub struct Attention {
    /// Of queries, keys, values, and the result.
    pub linears: Vec<Dense>,
    /// Heads.
    #[module(skip)]
    pub heads: usize,
}

impl Attention {
    fn init(config: &TransformerConfig, init: &mut Init<impl Rng>) -> Self {
        let linears = (0..4).map(|_| Dense::init(config.channels, config.channels, init)).collect();
        Self { linears, heads: config.heads }
    }

    /// `[batch, points, channels]` of those who ask, and of those who are asked.
    fn forward(&self, queries: Tensor<3>, memory: &Tensor<3>) -> Tensor<3> {
        let scale = 1.0 / ((queries.dims()[2] / self.heads) as f32).sqrt();
        let queries = self.linears[0].forward_batch(queries);
        let [keys, values] = [1, 2].map(|map| self.linears[map].forward_batch(memory.clone()));
        self.linears[3].forward_batch(ops::attention(queries, keys, values, self.heads, scale))
    }
}

/// A map of each point with one hidden layer.
#[derive(Module, Debug)]
pub struct FeedForward {
    /// To the hidden layer.
    pub w_1: Dense,
    /// From it.
    pub w_2: Dense,
    /// Of the rectifier between them.
    #[module(skip)]
    pub negative_slope: f32,
}

impl FeedForward {
    fn init(config: &TransformerConfig, negative_slope: f32, init: &mut Init<impl Rng>) -> Self {
        Self {
            w_1: Dense::init(config.channels, config.inner, init),
            w_2: Dense::init(config.inner, config.channels, init),
            negative_slope,
        }
    }

    fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        self.w_2.forward_batch(self.w_1.rectified_batch(x, self.negative_slope))
    }
}
