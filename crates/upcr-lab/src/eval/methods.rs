//! The methods that evaluations compare, each as a function from a pair of clouds to a pose.

use upcr::net::Network;
use upcr::{Error, Method, PointCloud, Refinement, Result, Rigid, Settings, register};

/// A method under its name.
#[derive(Clone)]
pub struct EvaluatedMethod {
    /// As a user types it.
    pub name: &'static str,
    estimate: fn(&PointCloud, &PointCloud, &Settings) -> Result<Rigid>,
}

/// Every method there is. A new one is a line here.
pub const METHODS: [EvaluatedMethod; 8] = [
    EvaluatedMethod { name: "upcr", estimate: one_pass },
    EvaluatedMethod { name: "upcr+refine", estimate: one_pass_refined },
    EvaluatedMethod { name: "icp", estimate: icp },
    EvaluatedMethod { name: "gicp", estimate: gicp },
    EvaluatedMethod { name: "fgr", estimate: fgr },
    EvaluatedMethod { name: "consensus", estimate: consensus },
    EvaluatedMethod { name: "features", estimate: features },
    EvaluatedMethod { name: "default", estimate: default },
];

impl EvaluatedMethod {
    /// The method of that name.
    ///
    /// # Errors
    /// Where there is none.
    pub fn by_name(name: &str) -> Result<Self> {
        METHODS.into_iter().find(|method| method.name == name).ok_or_else(|| {
            let known: Vec<_> = METHODS.iter().map(|method| method.name).collect();
            let reason = format!("there is no {name}; there are {}", known.join(", "));
            Error::InvalidSetting { name: "methods", reason }
        })
    }

    /// The pose that lays `source` on `target`. `settings` say with which network and seed.
    ///
    /// # Errors
    /// As the method says.
    pub fn estimate(&self, source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Rigid> {
        (self.estimate)(source, target, settings)
    }
}

/// The network alone, once.
fn one_pass(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Rigid> {
    let single =
        |cloud: &PointCloud| -> Vec<[f32; 3]> { cloud.points.iter().map(|p| p.map(|v| v as f32)).collect() };
    let network = settings.network.clone().map_or_else(Network::embedded, Ok)?;
    network.predict(&single(source), &single(target))
}

/// The network once, and the default refinement from there.
fn one_pass_refined(source: &PointCloud, target: &PointCloud, settings: &Settings) -> Result<Rigid> {
    let init = Some(one_pass(source, target, settings)?);
    let settings = Settings { method: Method::Prior, init, ..settings.clone() };
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
