//! What holds for every registration, right or wrong.

use nalgebra::Matrix3;
use upcr::{Registration, Rigid};

/// Every method, refinement and kernel that a user can choose.
pub mod choices {
    use upcr::{Method, Refinement, RobustKernel, features::MatchedFeature};

    pub const METHODS: [Method; 7] = [
        Method::Auto,
        Method::Features,
        Method::Prior,
        Method::Upcr,
        Method::Fgr,
        Method::Ransac,
        Method::Consensus,
    ];
    pub const REFINEMENTS: [Refinement; 4] =
        [Refinement::Gicp, Refinement::Plane, Refinement::Point, Refinement::None];
    pub const KERNELS: [RobustKernel; 5] = [
        RobustKernel::None,
        RobustKernel::Huber,
        RobustKernel::Cauchy,
        RobustKernel::GemanMcclure,
        RobustKernel::Tukey,
    ];
    pub const FEATURES: [MatchedFeature; 3] =
        [MatchedFeature::Fpfh, MatchedFeature::Spfh, MatchedFeature::Pfh];
}

/// Whether a pose is a finite rotation, no reflection, and a finite translation.
pub fn is_proper(T: &Rigid) -> bool {
    // A NaN compares as false.
    (T.rotation.transpose() * T.rotation - Matrix3::identity()).amax() < 1e-9
        && T.rotation.determinant() > 0.0
        && T.translation.iter().all(|v| v.is_finite())
}

/// What contradicts itself in an answer; nothing, where all is well.
pub fn inconsistencies(found: &Registration) -> Vec<String> {
    let mut wrong = Vec::new();
    let mut demand = |holds: bool, what: String| {
        if !holds {
            wrong.push(what);
        }
    };
    let T = &found.T_target_source;
    demand(is_proper(T), format!("no rigid motion: {T:?}"));
    demand((0.0..=1.0).contains(&found.fitness), format!("fitness {}", found.fitness));
    demand((0.0..=1.0).contains(&found.probability), format!("probability {}", found.probability));
    demand((0.0..=found.voxel_size).contains(&found.inlier_rmse), format!("rmse {}", found.inlier_rmse));
    let voxel_size = found.voxel_size;
    demand(voxel_size.is_finite() && voxel_size > 0.0, format!("voxel size {voxel_size}"));
    demand(is_covariance(&found.covariance), format!("no covariance: {:?}", found.covariance));
    demand(found.converged || !found.reasons.is_empty(), "not converged, without a reason".into());
    let distrusted = !found.is_trustworthy();
    let probability = found.probability;
    demand(
        !distrusted || !found.reasons.is_empty(),
        format!("distrusted without a reason, probability {probability:.3}"),
    );
    let nothing = found.num_inliers == 0;
    demand(!nothing || (distrusted && !found.converged), format!("no inliers, but p = {probability:.3}"));

    let (init, locks) = (found.settings.init.unwrap_or_else(Rigid::identity), found.settings.locks.flags());
    for axis in (0..3).filter(|axis| locks[3 + axis]) {
        let (is, held) = (T.translation[axis], init.translation[axis]);
        demand(is == held, format!("translation {axis} is locked at {held:e}, but {is:e}"));
    }
    wrong
}

/// Whether it is finite, symmetric, and correlates nothing by more than 1.
fn is_covariance(c: &[[f64; 6]; 6]) -> bool {
    (0..6).flat_map(|row| (0..6).map(move |column| (row, column))).all(|(row, column)| {
        // Where residuals vanish, products of variances do before these.
        let bound = c[row][row].sqrt() * c[column][column].sqrt() * (1.0 + 1e-6) + f64::MIN_POSITIVE;
        c[row][row] >= 0.0
            && c[row][column].is_finite()
            && c[row][column].abs() <= bound
            && (c[row][column] - c[column][row]).abs() <= 1e-6 * bound
    })
}

/// Fails where an answer contradicts itself.
#[track_caller]
pub fn assert_consistent(found: &Registration) {
    let wrong = inconsistencies(found);
    assert!(wrong.is_empty(), "{wrong:#?}\n{found:#?}");
}
