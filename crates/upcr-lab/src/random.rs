//! Seeded random numbers: one stream a purpose, so that no result depends on the number of threads.

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The stream numbered `stream` of `seed`; different streams are independent.
pub fn stream(seed: u64, stream: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(stream);
    rng
}

/// A draw from N(0, 1).
pub fn normal(rng: &mut impl Rng) -> f64 {
    // Box–Muller; 1 - u lies in (0, 1], where the logarithm is finite.
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

/// A direction uniform on the unit sphere.
pub fn direction(rng: &mut impl Rng) -> Vector3<f64> {
    let height = rng.random_range(-1.0..=1.0_f64);
    let (sin, cos) = rng.random_range(0.0..std::f64::consts::TAU).sin_cos();
    let radius = (1.0 - height * height).sqrt();
    Vector3::new(radius * cos, radius * sin, height)
}

/// A rotation uniform over SO(3).
pub fn rotation(rng: &mut impl Rng) -> Matrix3<f64> {
    let quaternion = Quaternion::new(normal(rng), normal(rng), normal(rng), normal(rng));
    UnitQuaternion::from_quaternion(quaternion).to_rotation_matrix().into_inner()
}

/// A number from a text or bytes: its 64-bit Fowler–Noll–Vo hash (1a), which unlike the standard library's never changes.
pub fn fnv1a(text: &(impl AsRef<[u8]> + ?Sized)) -> u64 {
    text.as_ref().iter().fold(0xcbf2_9ce4_8422_2325, |hash, &byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_those_of_the_laws() {
        let mut rng = stream(1, 0);
        let n = 20_000;
        let draws: Vec<f64> = (0..n).map(|_| normal(&mut rng)).collect();
        let mean = draws.iter().sum::<f64>() / n as f64;
        let variance = draws.iter().map(|x| x * x).sum::<f64>() / n as f64;
        assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.04, "{mean} {variance}");

        let mean_direction = (0..n).map(|_| direction(&mut rng)).sum::<Vector3<f64>>() / n as f64;
        assert!(mean_direction.norm() < 0.03);
        // The trace of a uniform rotation has mean 0 and variance 1.
        let traces: Vec<f64> = (0..n).map(|_| rotation(&mut rng).trace()).collect();
        assert!((traces.iter().sum::<f64>() / n as f64).abs() < 0.03);
        assert!((traces.iter().map(|t| t * t).sum::<f64>() / n as f64 - 1.0).abs() < 0.05);
    }

    #[test]
    fn hashes_are_those_published() {
        assert_eq!(fnv1a(""), 0xcbf2_9ce4_8422_2325);
        assert_eq!(fnv1a("a"), 0xaf63_dc4c_8601_ec8c);
    }

    #[test]
    fn streams_differ() {
        assert_ne!(stream(1, 0).random::<u64>(), stream(1, 1).random::<u64>());
    }
}
