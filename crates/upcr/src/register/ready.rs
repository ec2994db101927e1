//! Scans that are made ready once and registered with many others.

use web_time::Instant;

use super::{Pipeline, describe, milliseconds};
use crate::{
    CloudRole, Error, PointCloud, Result,
    features::{Descriptors, MatchedFeature},
    prepare::{Described, Prepared, check, natural_voxel_size, prepare},
    registration::Registration,
    settings::{Method, Settings},
    watch::{Call, Stop, Watch},
};

/// A scan at one scale, with all that registrations need of it.
pub struct ReadyScan {
    pub(super) prepared: Prepared,
    pub(super) descriptors: Descriptors,
    voxel_size: f64,
    feature: MatchedFeature,
}

impl std::fmt::Debug for ReadyScan {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ReadyScan")
            .field("points", &self.prepared.fine.points.len())
            .field("voxel_size", &self.voxel_size)
            .finish_non_exhaustive()
    }
}

impl ReadyScan {
    /// Makes a scan ready at `voxel_size`.
    ///
    /// # Errors
    /// As [`crate::register`], where the cloud or the voxel size is of no use.
    pub fn new(cloud: &PointCloud, voxel_size: f64, feature: MatchedFeature) -> Result<Self> {
        let call = Call::new(None, Watch::default());
        let ready = || -> Result<Self, Stop> {
            let checked = check(cloud, CloudRole::Cloud, &call)?;
            let prepared = prepare(&checked, voxel_size, Described::Surely, checked.len(), &call)?;
            let descriptors = describe(prepared.coarse(), feature.feature(), &call)?;
            Ok(Self { prepared, descriptors, voxel_size, feature })
        };
        ready().map_err(|stop| match stop {
            Stop::Failed(error) => error,
            Stop::Over | Stop::Full => Error::InvalidSetting {
                name: "voxel_size",
                reason: format!("{voxel_size} divides the scan into too many cells"),
            },
        })
    }

    /// The scale that fits the scan: its point spacing, or coarser where that leaves more points than features need.
    ///
    /// # Errors
    /// As [`crate::register`], where the cloud is of no use.
    pub fn natural_voxel_size(cloud: &PointCloud) -> Result<f64> {
        match check(cloud, CloudRole::Cloud, &Call::new(None, Watch::default())) {
            Ok(checked) => Ok(natural_voxel_size(&checked)),
            Err(Stop::Failed(error)) => Err(error),
            // Nothing ends this call.
            Err(Stop::Over | Stop::Full) => Ok(0.0),
        }
    }

    /// The middle of the scan's bounding box, in its own frame: what covariances of poses are told about.
    pub fn center(&self) -> [f64; 3] {
        self.prepared.origin
    }

    /// Largest distance of a point from the [centre](Self::center).
    pub fn radius(&self) -> f64 {
        f64::from(self.prepared.fine.radius)
    }

    /// Points that carry features, less the [centre](Self::center), and their descriptors.
    pub fn features(&self) -> (&[[f32; 3]], &Descriptors) {
        (&self.prepared.coarse().points, &self.descriptors)
    }

    /// At most `count` of the scan's points, less the [centre](Self::center).
    pub fn sample(&self, count: usize) -> Vec<[f32; 3]> {
        let level = &self.prepared.fine;
        level.spread(count).into_iter().map(|i| level.points[i as usize]).collect()
    }

    /// Bytes that it takes, about.
    pub fn bytes(&self) -> usize {
        // Coordinates, normals, the tree with its copy of the points, and neighbourhoods where features were asked for.
        const POINT: usize = 64;
        const FEATURE_POINT: usize = 4 * 48 + 64;
        POINT * self.prepared.fine.points.len()
            + FEATURE_POINT * self.prepared.coarse().points.len()
            + 4 * self.descriptors.values.len()
    }
}

/// As [`crate::register`], of scans made ready at one scale by one feature. The network is asked where the method says so alone, and what
/// scale would fit is not looked for.
///
/// # Errors
/// Where a setting is out of its range, or the scans were not made ready alike.
pub fn register_ready(source: &ReadyScan, target: &ReadyScan, settings: &Settings) -> Result<Registration> {
    settings.check()?;
    if source.voxel_size != target.voxel_size || source.feature != target.feature {
        return Err(Error::InvalidSetting {
            name: "voxel_size",
            reason: "scans are to be made ready at one scale, by one feature".into(),
        });
    }
    let start = Instant::now();
    let call = Call::new(settings.max_seconds, Watch::default());
    let asks_network = settings.method == Method::Upcr;
    let mut pipeline =
        Pipeline::new(&source.prepared, &target.prepared, source.voxel_size, asks_network, settings, &call)?;
    pipeline.descriptors = Some([&source.descriptors, &target.descriptors]);
    // They are there at little cost, and speak for or against a given pose too.
    pipeline.matches = pipeline.feature_matches()?;
    let mut found = pipeline.best()?;
    found.timings_ms.total = milliseconds(start);
    Ok(found)
}
