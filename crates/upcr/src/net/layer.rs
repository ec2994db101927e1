//! Graph layers without an edge tensor (equation 2).
//!
//! A layer's map over the edge i → j, `Wᵀ[Fᵢ ; Fⱼ − Fᵢ]`, is `(W₁ − W₂)ᵀFᵢ + W₂ᵀFⱼ`: two products a point, not one an
//! edge. Batch norm with a positive scale and the leaky rectifier grow with their argument, so the maximum over the
//! neighbours can be taken before them; a negative scale is folded into the weights first.

use super::aligned::Aligned;
use super::graph::PairedRows;
use super::kernel;
use super::lanes::{BLOCK, Lanes, whole_tiles};
use super::weights::Affine;
use super::{Graph, InvariantInputs};

/// One row of features a point, `stride` values apart, in whole tiles.
#[derive(Debug, Default)]
pub(super) struct Features {
    pub values: Aligned<f32>,
    pub stride: usize,
}

impl Features {
    /// Room for rows of `channels` values, or more; what it holds is of no meaning.
    pub fn reserve(&mut self, points: usize, channels: usize) {
        self.stride = channels;
        self.values.resize(self.values.len().max(whole_tiles(points) * channels), 0.0);
    }

    /// Takes over rows of `channels` values.
    pub fn copy_from(&mut self, rows: &[f32], channels: usize) {
        self.reserve(rows.len().checked_div(channels).unwrap_or(0), channels);
        self.values[..rows.len()].copy_from_slice(rows);
    }
}

/// The products of one block of channels.
#[derive(Debug, Default)]
pub(super) struct Products {
    center: Aligned<Lanes>,
    neighbor: Aligned<Lanes>,
}

impl Products {
    fn reserve(&mut self, points: usize) {
        self.center.resize(whole_tiles(points), [0.0; BLOCK]);
        self.neighbor.resize(whole_tiles(points), [0.0; BLOCK]);
    }
}

/// A layer over the graph, packed for inference.
#[derive(Debug, Clone)]
pub(super) struct GraphLayer {
    slope: f32,
    blocks: Vec<Block>,
}

/// Weights of one block of channels, a row an input. Channels beyond the layer's have none.
#[derive(Debug, Clone)]
struct Block {
    /// W₁ − W₂
    center: Aligned<Lanes>,
    /// W₂
    neighbor: Aligned<Lanes>,
    shift: Lanes,
}

impl GraphLayer {
    /// From the map over `[Fᵢ ; Fⱼ − Fᵢ]`.
    pub fn new(map: &Affine, slope: f32) -> Self {
        let inputs = map.inputs / 2;
        let blocks = blocks(map.outputs)
            .map(|block| {
                let neighbor: Aligned<Lanes> = (0..inputs).map(|k| block.of(map.row(inputs + k))).collect();
                let center = (0..inputs).zip(neighbor.iter()).map(|(k, w2)| {
                    let w1 = block.of(map.row(k));
                    std::array::from_fn(|l| w1[l] - w2[l])
                });
                Block { center: center.collect(), shift: block.of(&map.shift), neighbor }
            })
            .collect();
        Self { slope, blocks }
    }

    /// The layer's features from those of the layer before it.
    pub fn apply(
        &self,
        input: &Features,
        points: usize,
        rows: &PairedRows,
        products: &mut Products,
        output: &mut Features,
    ) {
        output.reserve(points, self.blocks.len() * BLOCK);
        for (b, block) in self.blocks.iter().enumerate() {
            block.multiply(input, points, products);
            let (out, stride) = (&mut output.values[b * BLOCK..], output.stride);
            kernel::gather(&products.center, &products.neighbor, rows, self.slope, out, stride);
        }
    }
}

impl Block {
    fn multiply(&self, input: &Features, points: usize, products: &mut Products) {
        products.reserve(points);
        let Features { values, stride } = input;
        kernel::multiply(values, *stride, &self.center, &self.shift, &mut products.center);
        kernel::multiply(values, *stride, &self.neighbor, &[0.0; BLOCK], &mut products.neighbor);
    }
}

/// The first layer of the second branch: a map of φ over every edge, packed for inference.
#[derive(Debug, Clone)]
pub(super) struct Embedding {
    slope: f32,
    blocks: Vec<EmbeddingBlock>,
}

#[derive(Debug, Clone)]
struct EmbeddingBlock {
    /// For what belongs to the edge.
    edge: Aligned<Lanes>,
    /// For what its neighbour brings.
    point: Aligned<Lanes>,
    shift: Lanes,
}

impl Embedding {
    /// From the map over φ, of whose inputs the first `edge_dim` belong to the edge.
    pub fn new(map: &Affine, edge_dim: usize, slope: f32) -> Self {
        let blocks = blocks(map.outputs)
            .map(|block| {
                let rows = |range: std::ops::Range<usize>| range.map(|k| block.of(map.row(k))).collect();
                EmbeddingBlock {
                    edge: rows(0..edge_dim),
                    point: rows(edge_dim..map.inputs),
                    shift: block.of(&map.shift),
                }
            })
            .collect();
        Self { slope, blocks }
    }

    /// Φ⁰ (equation 4).
    pub fn apply(
        &self,
        inputs: &InvariantInputs,
        graph: &Graph,
        room: &mut Features,
        products: &mut Products,
        output: &mut Features,
    ) {
        output.reserve(graph.len(), self.blocks.len() * BLOCK);
        products.reserve(graph.len());
        room.copy_from(&inputs.points, inputs.point_dim);
        for (b, block) in self.blocks.iter().enumerate() {
            if inputs.point_dim == 0 {
                products.neighbor.fill(block.shift);
            } else {
                let neighbor = &mut products.neighbor;
                kernel::multiply(&room.values, room.stride, &block.point, &block.shift, neighbor);
            }
            let (out, stride) = (&mut output.values[b * BLOCK..], output.stride);
            kernel::embed(&inputs.edges, &block.edge, &products.neighbor, graph, self.slope, out, stride);
        }
    }
}

/// A block of a layer's channels.
pub(super) struct Channels(usize);

pub(super) fn blocks(channels: usize) -> impl Iterator<Item = Channels> {
    (0..channels).step_by(BLOCK).map(Channels)
}

impl Channels {
    /// The block's part of one value a channel, zero beyond the last.
    pub fn of(&self, values: &[f32]) -> Lanes {
        std::array::from_fn(|l| values.get(self.0 + l).copied().unwrap_or(0.0))
    }
}
