//! The parts scenes are put together from.

use std::f64::consts::{PI, TAU};

use nalgebra::{Rotation3, Vector3};
use rand::Rng;
use upcr::{Rigid, TriangleMesh};

use crate::random;

type V = Vector3<f64>;

/// A mesh that grows part by part; closed parts are counter-clockwise seen from outside.
#[derive(Debug, Clone, Default)]
pub struct Assembly {
    pub mesh: TriangleMesh,
}

/// Smooth seeded noise over space: plane waves in random directions, each octave finer and weaker.
#[derive(Debug, Clone)]
pub struct Bumps {
    waves: Vec<(V, f64, f64)>,
}

/// Plane waves in an octave.
const WAVES: usize = 6;

impl Bumps {
    /// `amplitude` is the standard deviation of the first octave, whose wavelength is `wavelength`; each
    /// following one has half of that and `roughness` times the amplitude.
    pub fn new(rng: &mut impl Rng, octaves: i32, wavelength: f64, amplitude: f64, roughness: f64) -> Self {
        let mut wave = |octave: i32| {
            let frequency = TAU / wavelength * 2.0_f64.powi(octave) * rng.random_range(0.7..1.3);
            let amplitude = amplitude * roughness.powi(octave) * (2.0 / WAVES as f64).sqrt();
            (random::direction(rng) * frequency, rng.random_range(0.0..TAU), amplitude)
        };
        Self { waves: (0..octaves).flat_map(|o| [o; WAVES]).map(&mut wave).collect() }
    }

    pub fn at(&self, point: &V) -> f64 {
        self.waves.iter().map(|(k, phase, amplitude)| amplitude * (k.dot(point) + phase).sin()).sum()
    }
}

impl Assembly {
    /// The surface `at(u, v)` over the unit square; its outside is the side ∂u × ∂v.
    pub fn surface(&mut self, [u_steps, v_steps]: [usize; 2], at: impl Fn(f64, f64) -> V) {
        let first = self.mesh.vertices.len() as u32;
        for j in 0..=v_steps {
            for i in 0..=u_steps {
                self.mesh.vertices.push(at(i as f64 / u_steps as f64, j as f64 / v_steps as f64).into());
            }
        }
        let stride = u_steps as u32 + 1;
        for j in 0..v_steps as u32 {
            for i in 0..u_steps as u32 {
                let a = first + j * stride + i;
                let (b, c, d) = (a + 1, a + stride + 1, a + stride);
                self.mesh.triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
    }

    /// A flat quadrilateral, corners counter-clockwise seen from outside.
    pub fn quad(&mut self, [a, b, c, d]: [V; 4]) {
        self.surface([1, 1], |u, v| (a * (1.0 - u) + b * u) * (1.0 - v) + (d * (1.0 - u) + c * u) * v);
    }

    /// A box standing on the middle of its bottom face, turned by `yaw` about z.
    pub fn cuboid(&mut self, base: V, size: V, yaw: f64) {
        let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), yaw);
        let corner = |i: usize| {
            let at = |bit: usize| if i >> bit & 1 == 1 { 0.5 } else { -0.5 };
            base + turn * V::new(at(0) * size.x, at(1) * size.y, (at(2) + 0.5) * size.z)
        };
        let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        for face in faces {
            self.quad(face.map(corner));
        }
    }

    /// The polyline `profile` of (radius, height) turned about the vertical through `base`; closed and outside
    /// out where it starts and ends at radius 0 and rises.
    pub fn revolve(&mut self, base: V, profile: &[(f64, f64)], segments: usize) {
        let last = profile.len() - 1;
        self.surface([segments, last], |u, v| {
            let (radius, height) = profile[((v * last as f64).round() as usize).min(last)];
            let (sin, cos) = (TAU * u).sin_cos();
            base + V::new(radius * cos, radius * sin, height)
        });
    }

    /// A closed cylinder standing on `base`.
    pub fn cylinder(&mut self, base: V, radius: f64, height: f64) {
        self.revolve(base, &[(0.0, 0.0), (radius, 0.0), (radius, height), (0.0, height)], 24);
    }

    /// An ellipsoid, its radii scaled by 1 + `bumps` over the unit sphere, `steps` around its equator.
    pub fn blob(&mut self, center: V, radii: V, bumps: Option<&Bumps>, steps: usize) {
        self.surface([steps, steps / 2], |u, v| {
            let (sin, cos) = (TAU * u).sin_cos();
            let (height, radius) = (PI * (v - 0.5)).sin_cos();
            let direction = V::new(radius * cos, radius * sin, height);
            let swell = 1.0 + bumps.map_or(0.0, |b| b.at(&direction));
            center + direction.component_mul(&radii) * swell.max(0.1)
        });
    }

    /// Adds another assembly, moved.
    pub fn append(&mut self, part: &Self, T_self_part: &Rigid) {
        let first = self.mesh.vertices.len() as u32;
        self.mesh.vertices.extend(part.mesh.vertices.iter().map(|&v| T_self_part.apply(v)));
        self.mesh.triangles.extend(part.mesh.triangles.iter().map(|t| t.map(|i| first + i)));
    }
}

/// The pose of something standing at `at`, turned by `yaw` about z.
pub fn standing(at: V, yaw: f64) -> Rigid {
    let rotation = Rotation3::from_axis_angle(&Vector3::z_axis(), yaw).into_inner();
    Rigid { rotation, translation: at }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn volume(mesh: &TriangleMesh) -> f64 {
        let corner = |i: u32| V::from(mesh.vertices[i as usize]);
        mesh.triangles.iter().map(|t| corner(t[0]).dot(&corner(t[1]).cross(&corner(t[2]))) / 6.0).sum()
    }

    #[test]
    fn closed_parts_enclose_their_volume_outside_out() {
        let base = V::new(1.0, -2.0, 0.5);
        let mut cuboid = Assembly::default();
        cuboid.cuboid(base, V::new(1.0, 2.0, 3.0), 0.7);
        assert!((volume(&cuboid.mesh) - 6.0).abs() < 1e-9);

        let mut cylinder = Assembly::default();
        cylinder.cylinder(base, 0.5, 2.0);
        assert!((volume(&cylinder.mesh) / (PI * 0.5) - 1.0).abs() < 0.02);

        let mut blob = Assembly::default();
        blob.blob(base, V::new(1.0, 2.0, 0.5), None, 64);
        assert!((volume(&blob.mesh) / (PI * 4.0 / 3.0) - 1.0).abs() < 0.01);

        let mut moved = Assembly::default();
        moved.append(&blob, &standing(V::new(3.0, 0.0, 0.0), 1.0));
        assert!((volume(&moved.mesh) - volume(&blob.mesh)).abs() < 1e-9);
    }

    #[test]
    fn bumps_have_their_amplitude() {
        let mut rng = random::stream(3, 0);
        let bumps = Bumps::new(&mut rng, 1, 1.0, 0.1, 0.5);
        let n = 20_000;
        let variance =
            (0..n).map(|_| bumps.at(&(random::direction(&mut rng) * 50.0)).powi(2)).sum::<f64>() / n as f64;
        assert!((variance.sqrt() - 0.1).abs() < 0.01, "{variance}");
    }
}
