//! The methods that evaluations compare, each as a function from a pair of clouds to a pose.

use std::sync::Arc;
#[cfg(feature = "train")]
use std::sync::{Mutex, PoisonError};

use upcr::features::MatchedFeature;
use upcr::net::Network;
use upcr::{Error, Method, PointCloud, Refinement, Result, Rigid, Settings, register};

#[cfg(feature = "train")]
use crate::models::Learned;

/// What a method does with a source and a target.
type Estimate = dyn Fn(&PointCloud, &PointCloud, &Settings) -> Result<Rigid> + Send + Sync;

/// A method under its name.
#[derive(Clone)]
pub struct EvaluatedMethod {
    /// As a user types it.
    pub name: String,
    estimate: Arc<Estimate>,
}

/// A method that is a function.
type Plain = fn(&PointCloud, &PointCloud, &Settings) -> Result<Rigid>;

/// Every method that needs no file. A new one is a line here.
const METHODS: [(&str, Plain); 11] = [
    ("upcr", one_pass),
    ("upcr+refine", one_pass_refined),
    ("upcr+register", upcr_alone),
    ("icp", icp),
    ("gicp", gicp),
    ("fgr", fgr),
    ("icp+spfh", icp_spfh),
    ("icp+pfh", icp_pfh),
    ("consensus", consensus),
    ("features", features),
    ("default", default),
];

impl EvaluatedMethod {
    /// The method of that name.
    ///
    /// # Errors
    /// Where there is none.
    pub fn by_name(name: &str) -> Result<Self> {
        let found = METHODS.into_iter().find(|(known, _)| *known == name);
        found.map(|(name, estimate)| Self { name: name.into(), estimate: Arc::new(estimate) }).ok_or_else(
            || {
                let known = METHODS.map(|(name, _)| name).join(", ");
                let reason =
                    format!("there is no {name}; there are {known}, and NAME=WEIGHTS for trained networks");
                Error::InvalidSetting { name: "methods", reason }
            },
        )
    }

    /// A network of any kind, alone. Weights of UPCR's are better given to `upcr`, which runs them many times faster.
    #[cfg(feature = "train")]
    pub fn learned(name: &str, network: Learned) -> Self {
        // A network's tensors are not shared between threads.
        let network = Mutex::new(network);
        let estimate = move |source: &PointCloud, target: &PointCloud, _: &Settings| {
            let network = network.lock().unwrap_or_else(PoisonError::into_inner).clone();
            network.predict(single(source), single(target))
        };
        Self { name: name.into(), estimate: Arc::new(estimate) }
    }

    /// The same method with a network of its own, under another name.
    #[must_use]
    pub fn with_network(self, name: &str, network: Network) -> Self {
        let network = Arc::new(network);
        let estimate = move |source: &PointCloud, target: &PointCloud, settings: &Settings| {
            let settings = Settings { network: Some(network.clone()), ..settings.clone() };
            self.estimate(source, target, &settings)
        };
        Self { name: name.into(), estimate: Arc::new(estimate) }
    }

    /// The pose that lays `source` on `target`. `settings` say with which network and seed.
    ///
    /// # Errors
    /// As the method says.
    pub fn estimate(&self, source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Rigid> {
        (self.estimate)(source, target, settings)
    }
}

fn single(cloud: &PointCloud) -> Vec<[f32; 3]> {
    cloud.points.iter().map(|p| p.map(|v| v as f32)).collect()
}

/// The network alone, once.
fn one_pass(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Rigid> {
    let network = settings.network.clone().map_or_else(Network::embedded, Ok)?;
    network.predict(&single(source), &single(target))
}

/// The network once, and the default refinement from there.
fn one_pass_refined(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Rigid> {
    let init = Some(one_pass(source, target, settings)?);
    let settings = Settings { method: Method::Prior, init, ..settings.clone() };
    Ok(register(source, target, &settings)?.T_target_source)
}

/// What `register` does when the network is the only source of first poses: clouds of any size and place.
fn upcr_alone(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Rigid> {
    let settings = Settings { method: Method::Upcr, ..settings.clone() };
    Ok(register(source, target, &settings)?.T_target_source)
}

/// Point-to-point ICP from the identity.
fn icp(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Rigid> {
    let settings = Settings { method: Method::Prior, refine: Refinement::Point, ..settings.clone() };
    Ok(register(source, target, &settings)?.T_target_source)
}

/// Generalised ICP from the identity.
fn gicp(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Rigid> {
    let settings = Settings { method: Method::Prior, refine: Refinement::Gicp, ..settings.clone() };
    Ok(register(source, target, &settings)?.T_target_source)
}

/// Fast Global Registration as published, without a refinement after it.
fn fgr(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Rigid> {
    let settings = Settings { method: Method::Fgr, refine: Refinement::None, ..settings.clone() };
    Ok(register(source, target, &settings)?.T_target_source)
}

/// The paper's ICP + SPFH: as [`icp_after`] has it.
fn icp_spfh(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Rigid> {
    icp_after(MatchedFeature::Spfh, source, target, settings)
}

/// The paper's ICP + PFH: as [`icp_after`] has it.
fn icp_pfh(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Rigid> {
    icp_after(MatchedFeature::Pfh, source, target, settings)
}

/// The pose of nearest features that most of them agree with (RANSAC), and point-to-point ICP from there. The paper does
/// not say how matches become a pose.
fn icp_after(
    feature: MatchedFeature,
    source: &PointCloud,
    target: &PointCloud,
    settings: &Settings,
) -> Result<Rigid> {
    let settings =
        Settings { method: Method::Ransac, feature, refine: Refinement::Point, ..settings.clone() };
    Ok(register(source, target, &settings)?.T_target_source)
}

/// Feature matches that agree with each other, and the default refinement from there.
fn consensus(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Rigid> {
    let settings = Settings { method: Method::Consensus, ..settings.clone() };
    Ok(register(source, target, &settings)?.T_target_source)
}

/// What `register` does without the network.
fn features(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Rigid> {
    let settings = Settings { method: Method::Features, ..settings.clone() };
    Ok(register(source, target, &settings)?.T_target_source)
}

/// What `register` does when it is told nothing.
fn default(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Rigid> {
    Ok(register(source, target, settings)?.T_target_source)
}
