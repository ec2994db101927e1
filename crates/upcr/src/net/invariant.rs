//! The pose-invariant edge feature φ that the second branch starts from (section II-A).

use serde::{Deserialize, Serialize};

use crate::{
    cloud::{local_planes, orient_by_curvature},
    error::Result,
    features::{Descriptors, Distance, Feature, FeatureInput, Pfh, Ppf, Spfh},
    neighbors::Neighborhoods,
};

/// What φ is made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum), value(rename_all = "snake_case"))]
pub enum Invariant {
    /// No second branch: the pose is read from the whole representation (the paper's ablation).
    None,
    /// Distances among point, neighbour and centroid.
    #[default]
    Distance,
    /// Point pair features.
    Ppf,
    /// Simplified point feature histogram of the neighbour.
    Spfh,
    /// Point feature histogram of the neighbour.
    Pfh,
    /// Distances and point pair features.
    DistancePpf,
    /// Distances and the neighbour's simplified histogram.
    DistanceSpfh,
    /// Distances, point pair features and the neighbour's simplified histogram.
    DistancePpfSpfh,
}

/// φ of every edge of a cloud, in two parts: what belongs to the edge, and what its neighbour brings. φ of the edge
/// from point i to its neighbour j is `edges[i·k + slot]` followed by `points[j]`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct InvariantInputs {
    /// Values an edge.
    pub edge_dim: usize,
    /// `n · k · edge_dim` values.
    pub edges: Vec<f32>,
    /// Values a point.
    pub point_dim: usize,
    /// `n · point_dim` values.
    pub points: Vec<f32>,
}

impl Invariant {
    /// Features that are values of an edge, in φ's order.
    fn of_edges(self) -> &'static [&'static dyn Feature] {
        match self {
            Self::None | Self::Spfh | Self::Pfh => &[],
            Self::Distance | Self::DistanceSpfh => &[&Distance],
            Self::Ppf => &[&Ppf],
            Self::DistancePpf | Self::DistancePpfSpfh => &[&Distance, &Ppf],
        }
    }

    /// Feature that is a histogram of the neighbour.
    fn of_points(self) -> Option<&'static dyn Feature> {
        match self {
            Self::None | Self::Distance | Self::Ppf | Self::DistancePpf => None,
            Self::Spfh | Self::DistanceSpfh | Self::DistancePpfSpfh => Some(&Spfh),
            Self::Pfh => Some(&Pfh),
        }
    }

    /// Values of φ that belong to the edge.
    pub fn edge_dim(self) -> usize {
        self.of_edges().iter().map(|feature| feature.dim(1)).sum()
    }

    /// Values of φ that the neighbour brings.
    pub fn point_dim(self) -> usize {
        self.of_points().map_or(0, |feature| feature.dim(1))
    }

    /// φ over the edges of a cloud. Normals, where they are needed, are estimated from the same neighbours.
    ///
    /// # Errors
    /// Where `neighborhoods` are not those of `points`.
    pub fn inputs(self, points: &[[f32; 3]], neighborhoods: &Neighborhoods) -> Result<InvariantInputs> {
        let of_edges = self.of_edges();
        let needs_normals = of_edges.iter().copied().chain(self.of_points()).any(Feature::needs_normals);
        let mut normals = Vec::new();
        if needs_normals {
            normals.extend(local_planes(points, neighborhoods).iter().map(|plane| plane.normal));
            orient_by_curvature(points, &mut normals, neighborhoods);
        }
        let input = FeatureInput { points, normals: &normals, neighborhoods };
        let parts = of_edges.iter().map(|f| f.compute(&input)).collect::<Result<Vec<_>>>()?;
        let of_points = self.of_points().map(|f| f.compute(&input)).transpose()?;
        let (point_dim, points) = of_points.map_or((0, Vec::new()), |d| (d.dim, d.values));
        let edge_dim = self.edge_dim();
        Ok(InvariantInputs { edge_dim, edges: concatenated(parts, edge_dim, of_edges), point_dim, points })
    }
}

/// Several edge features as one row an edge.
fn concatenated(mut parts: Vec<Descriptors>, edge_dim: usize, features: &[&dyn Feature]) -> Vec<f32> {
    if parts.len() < 2 {
        return parts.pop().map_or(Vec::new(), |part| part.values);
    }
    let edges = parts[0].values.len() / features[0].dim(1);
    let mut values = vec![0.0; edges * edge_dim];
    let mut offset = 0;
    for (part, feature) in parts.iter().zip(features) {
        let dim = feature.dim(1);
        for (edge, from) in values.chunks_exact_mut(edge_dim).zip(part.values.chunks_exact(dim)) {
            edge[offset..offset + dim].copy_from_slice(from);
        }
        offset += dim;
    }
    values
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Vector3};

    use super::*;
    use crate::neighbors::KdTree;

    const ALL: [Invariant; 8] = [
        Invariant::None,
        Invariant::Distance,
        Invariant::Ppf,
        Invariant::Spfh,
        Invariant::Pfh,
        Invariant::DistancePpf,
        Invariant::DistanceSpfh,
        Invariant::DistancePpfSpfh,
    ];

    /// An ellipsoid, along a spiral from pole to pole.
    fn surface() -> Vec<[f32; 3]> {
        (0..200)
            .map(|i| {
                let (z, turn) = ((i as f32 - 99.5) / 100.0, i as f32 * 2.4);
                let r = (1.0 - z * z).sqrt();
                [r * turn.cos(), 0.7 * r * turn.sin(), 0.5 * z]
            })
            .collect()
    }

    #[test]
    fn dimensions_are_as_announced() {
        let points = surface();
        let graph = KdTree::new(&points).knn_graph(7);
        for kind in ALL {
            let inputs = kind.inputs(&points, &graph).unwrap();
            assert_eq!((inputs.edge_dim, inputs.point_dim), (kind.edge_dim(), kind.point_dim()), "{kind:?}");
            assert_eq!(inputs.edges.len(), 200 * 7 * inputs.edge_dim, "{kind:?}");
            assert_eq!(inputs.points.len(), 200 * inputs.point_dim, "{kind:?}");
        }
    }

    #[test]
    fn joined_features_hold_their_parts() {
        let points = surface();
        let graph = KdTree::new(&points).knn_graph(5);
        let [distance, ppf, spfh, joined] =
            [Invariant::Distance, Invariant::Ppf, Invariant::Spfh, Invariant::DistancePpfSpfh]
                .map(|kind| kind.inputs(&points, &graph).unwrap());
        for (edge, row) in joined.edges.chunks_exact(7).enumerate() {
            assert_eq!(row[..3], distance.edges[edge * 3..][..3]);
            assert_eq!(row[3..], ppf.edges[edge * 4..][..4]);
        }
        assert_eq!(joined.points, spfh.points);
    }

    #[test]
    fn a_motion_changes_nothing() {
        let points = surface();
        let turn = Rotation3::from_euler_angles(0.3_f32, -0.8, 1.9);
        let moved: Vec<[f32; 3]> =
            points.iter().map(|p| (turn * Vector3::from(*p) + Vector3::new(0.2, -0.1, 0.4)).into()).collect();
        // The neighbours of the unmoved: rounding may order equally near ones otherwise.
        let graph = KdTree::new(&points).knn_graph(8);
        for kind in [Invariant::Distance, Invariant::Ppf, Invariant::DistancePpf] {
            let (before, after) =
                (kind.inputs(&points, &graph).unwrap(), kind.inputs(&moved, &graph).unwrap());
            let worst = before.edges.iter().zip(&after.edges).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 2e-3, "{kind:?} {worst}");
        }
    }
}
