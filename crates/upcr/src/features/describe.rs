//! From a cloud to its descriptors in one call.

use std::num::NonZeroUsize;

use serde::Serialize;
use web_time::Instant;

use super::{Descriptors, Feature, FeatureInput};
use crate::PointCloud;
use crate::cloud::{Support, local_planes, orient_by_curvature, orient_to_viewpoint};
use crate::error::{CloudRole, Error, Result};
use crate::neighbors::KdTree;
use crate::threads::on_threads;

/// Neighbours of a point, itself included, where nothing else is asked for.
pub const DEFAULT_K: usize = 24;
/// Neighbours, at most, that a radius search takes.
const MAX_RADIUS_NEIGHBORS: usize = 100;
/// Points that span a surface.
const MIN_POINTS: usize = 3;

/// Milliseconds spent in each step of [`describe`].
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct DescribeTimings {
    /// Index and neighbour search.
    pub neighbors: f64,
    /// Normals; none are estimated for a cloud that has them or a feature that needs none.
    pub normals: f64,
    /// The descriptors.
    pub feature: f64,
    /// All of it.
    pub total: f64,
}

/// The descriptor of every point of `cloud`, over the neighbours that `support` tells.
///
/// # Errors
/// Where the cloud has fewer than three points or some that are not finite, or `support` is out of range.
pub fn describe(
    cloud: &PointCloud,
    feature: &dyn Feature,
    support: Support,
    threads: Option<NonZeroUsize>,
) -> Result<(Descriptors, DescribeTimings)> {
    check(cloud, support)?;
    on_threads(threads, || run(cloud, feature, support))?
}

fn check(cloud: &PointCloud, support: Support) -> Result<()> {
    let invalid = |name, reason: &str| Err(Error::InvalidSetting { name, reason: reason.into() });
    match support {
        Support::Nearest(k) if k < MIN_POINTS => return invalid("k", "at least 3 neighbours are needed"),
        Support::Radius(radius) if !(radius > 0.0 && radius.is_finite()) => {
            return invalid("radius", "must be positive and finite");
        }
        _ => {}
    }
    if cloud.len() < MIN_POINTS {
        return Err(Error::TooFewPoints { role: CloudRole::Cloud, found: cloud.len(), needed: MIN_POINTS });
    }
    cloud.checked_bounds(CloudRole::Cloud)?;
    Ok(())
}

fn run(
    cloud: &PointCloud,
    feature: &dyn Feature,
    support: Support,
) -> Result<(Descriptors, DescribeTimings)> {
    let start = Instant::now();
    let mut last = start;
    let mut lap = || {
        let now = Instant::now();
        let ms = (now - last).as_secs_f64() * 1e3;
        last = now;
        ms
    };
    // About the first point, single precision serves georeferenced clouds as well.
    let origin = cloud.points[0];
    let points = cloud.local_points(origin);
    let tree = KdTree::new(&points);
    let neighborhoods = match support {
        Support::Nearest(k) => tree.knn_graph(k),
        Support::Radius(radius) => tree.radius_graph(radius as f32, MAX_RADIUS_NEIGHBORS),
    };
    let neighbors = lap();

    let mut estimated = Vec::new();
    let normals = match &cloud.normals {
        _ if !feature.needs_normals() => &[][..],
        Some(normals) => normals,
        None => {
            estimated.extend(local_planes(&points, &neighborhoods).iter().map(|plane| plane.normal));
            match cloud.viewpoint {
                Some(viewpoint) => {
                    let local = std::array::from_fn(|a| (viewpoint[a] - origin[a]) as f32);
                    orient_to_viewpoint(&points, &mut estimated, local);
                }
                None => orient_by_curvature(&points, &mut estimated, &neighborhoods),
            }
            &estimated
        }
    };
    let normals_ms = lap();
    let descriptors =
        feature.compute(&FeatureInput { points: &points, normals, neighborhoods: &neighborhoods })?;
    let timings = DescribeTimings {
        neighbors,
        normals: normals_ms,
        feature: lap(),
        total: start.elapsed().as_secs_f64() * 1e3,
    };
    Ok((descriptors, timings))
}
