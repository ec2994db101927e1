//! All that a registration can be told.

use std::num::NonZeroUsize;
use std::sync::Arc;

use nalgebra::Matrix3;
use serde::{Deserialize, Serialize, Serializer};

use crate::{
    Error, Result,
    features::MatchedFeature,
    net::Network,
    refine::{Locks, Refinement, RobustKernel},
    transform::{Rigid, nearest_rotation},
    verify::Calibration,
};

/// Where the first pose comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum), value(rename_all = "snake_case"))]
pub enum Method {
    /// Cheap sources first, dearer ones until the verifier is sure: the initial pose, where one is given, the network,
    /// then features.
    #[default]
    Auto,
    /// Sources that match features, cheap ones first: consensus, FGR, RANSAC.
    Features,
    /// The given initial pose alone (identity where none is given).
    Prior,
    /// The UPCR network.
    Upcr,
    /// Fast Global Registration.
    Fgr,
    /// Feature RANSAC.
    Ransac,
    /// Feature matches that agree with each other (second-order spatial compatibility).
    Consensus,
}

/// All that a registration can be told. `Settings::default()` is meant to be enough.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Settings {
    /// Where the first pose comes from.
    pub method: Method,
    /// The network that is asked; `None`: the one in the library.
    #[serde(serialize_with = "fingerprint")]
    pub network: Option<Arc<Network>>,
    /// The feature that is matched, where the method matches one.
    pub feature: MatchedFeature,
    /// What the refinement minimises.
    pub refine: Refinement,
    /// The one scale that drives every radius, in the clouds' unit; `None`: derived from the clouds.
    pub voxel_size: Option<f64>,
    /// A first guess of `T_target_source`, in the files' frames.
    pub init: Option<Rigid>,
    /// How residuals of the refinement are weighed.
    pub kernel: RobustKernel,
    /// Share of the closest pairs that the refinement keeps, 0 to 1; `None`: all within reach.
    pub overlap: Option<f64>,
    /// Degrees of freedom held at the initial pose's values.
    pub locks: Locks,
    /// What the evidence weighs; `None`: the calibration in the library.
    #[serde(serialize_with = "about")]
    pub calibration: Option<Arc<Calibration>>,
    /// Seed of every random choice.
    pub seed: u64,
    /// Threads to use; `None`: all that the current rayon pool has. The result does not depend on it.
    pub threads: Option<NonZeroUsize>,
    /// Seconds from the call on after which it ends, with the best pose so far; `None`: as many as it takes. Calls that
    /// share a rayon pool may wait for each other's steps.
    pub max_seconds: Option<f64>,
    /// Bytes that the call may take beyond its input clouds and a network of one's own; `None`: as many as it takes.
    /// Where a cloud needs more, only every so-many-th point of it is used ([`crate::Registration::points_used`]).
    pub max_memory_bytes: Option<u64>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            method: Method::Auto,
            network: None,
            feature: MatchedFeature::default(),
            refine: Refinement::Gicp,
            voxel_size: None,
            init: None,
            kernel: RobustKernel::default(),
            overlap: None,
            locks: Locks::default(),
            calibration: None,
            seed: 0,
            threads: None,
            max_seconds: None,
            max_memory_bytes: None,
        }
    }
}

impl Settings {
    /// The first guess, the identity where none is given. The matrix of one that somebody wrote down in few digits is
    /// replaced by the nearest rotation; any other is kept to the last bit.
    pub(crate) fn first_guess(&self) -> Rigid {
        const ROUNDING: f64 = 1e-12;
        let Some(init) = self.init else { return Rigid::identity() };
        let departure = (init.rotation.transpose() * init.rotation - Matrix3::identity()).amax();
        if departure < ROUNDING { init } else { Rigid { rotation: nearest_rotation(&init.rotation), ..init } }
    }

    /// Refuses what is out of range, as every registration does.
    ///
    /// # Errors
    /// [`Error::InvalidSetting`] with the setting's name.
    pub fn check(&self) -> Result<()> {
        let refused = |name, reason| Err(Error::InvalidSetting { name, reason });
        if let Some(v) = self.voxel_size
            && !(v.is_finite() && v > 0.0)
        {
            return refused("voxel_size", format!("must be a positive length, not {v}"));
        }
        if let Some(share) = self.overlap
            && !(share > 0.0 && share <= 1.0)
        {
            return refused("overlap", format!("must be a share above 0 and at most 1, not {share}"));
        }
        if let Some(seconds) = self.max_seconds
            && !(seconds.is_finite() && seconds >= 0.0)
        {
            return refused("max_seconds", format!("must be a time of at least 0 s, not {seconds}"));
        }
        if let Some(calibration) = &self.calibration
            && let Err(reason) = calibration.check()
        {
            return refused("calibration", reason);
        }
        if let Some(init) = &self.init
            && let Err(reason) = Rigid::from_rows(&init.to_rows())
        {
            return refused("init", reason);
        }
        Ok(())
    }
}

/// A network is told by its weights' fingerprint.
#[allow(clippy::ref_option)] // as serde calls it
fn fingerprint<S: Serializer>(network: &Option<Arc<Network>>, serializer: S) -> Result<S::Ok, S::Error> {
    match network {
        Some(network) => serializer.collect_str(&format_args!("{:016x}", network.fingerprint())),
        None => serializer.serialize_none(),
    }
}

/// A calibration is told by what it says of itself.
#[allow(clippy::ref_option)] // as serde calls it
fn about<S: Serializer>(calibration: &Option<Arc<Calibration>>, serializer: S) -> Result<S::Ok, S::Error> {
    match calibration {
        Some(calibration) => serializer.serialize_some(&calibration.about),
        None => serializer.serialize_none(),
    }
}
