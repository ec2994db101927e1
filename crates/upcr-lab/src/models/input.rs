//! What a network is given: clouds with their graphs and invariant features.

use std::sync::Arc;

use upcr::Result;
use upcr::neighbors::KdTree;
use upcr::net::{Graph, InvariantInputs, NetworkConfig, centered};

use crate::ops::BatchGraph;
use crate::ops::canonical_chamfer::PairPoints;
use crate::ops::edge_embed::EdgeInputs;

/// One cloud, about its centroid.
#[derive(Debug, Clone)]
pub struct CloudInput {
    /// Points minus the centroid.
    pub points: Vec<[f32; 3]>,
    /// Mean of the points.
    pub centroid: [f32; 3],
    /// Neighbours by position.
    pub graph: Graph,
    /// φ over the edges.
    pub phi: InvariantInputs,
}

impl CloudInput {
    /// Centres the points and looks up their neighbours.
    ///
    /// # Errors
    /// Where the invariant feature cannot be computed.
    pub fn new(cloud: &[[f32; 3]], config: &NetworkConfig) -> Result<Self> {
        let mut points = Vec::new();
        let centroid = centered(cloud, &mut points);
        let neighborhoods = KdTree::new(&points).knn_graph(config.k);
        let phi = config.invariant.inputs(&points, &neighborhoods)?;
        Ok(Self { points, centroid, graph: Graph::from(&neighborhoods), phi })
    }
}

/// The clouds of a batch of pairs: all sources, then all targets.
#[derive(Debug, Clone)]
pub struct Clouds {
    /// Points about the clouds' centroids.
    pub points: Arc<PairPoints>,
    /// The clouds' centroids.
    pub centroids: Vec<[f32; 3]>,
    /// Neighbours by position.
    pub graph: Arc<BatchGraph>,
    /// φ over the edges.
    pub phi: Arc<EdgeInputs>,
}

impl Clouds {
    /// Joins (source, target) pairs.
    pub fn new(pairs: &[(CloudInput, CloudInput)], k: usize) -> Self {
        let clouds = || pairs.iter().map(|(source, _)| source).chain(pairs.iter().map(|(_, target)| target));
        let graph = BatchGraph::new(clouds().map(|cloud| &cloud.graph), k);
        let phi = EdgeInputs::new(clouds().map(|cloud| &cloud.phi), &graph);
        let points = clouds().flat_map(|cloud| cloud.points.iter().copied()).collect();
        Self {
            points: Arc::new(PairPoints { points, offsets: graph.offsets.clone() }),
            centroids: clouds().map(|cloud| cloud.centroid).collect(),
            graph: Arc::new(graph),
            phi: Arc::new(phi),
        }
    }

    /// Number of pairs.
    pub fn pairs(&self) -> usize {
        self.centroids.len() / 2
    }
}
