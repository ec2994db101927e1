//! The sensors: which rays they cast, how far they see, and what they make of a range.

use std::f64::consts::{FRAC_PI_2, TAU};

use nalgebra::{Matrix3, Vector3};
use rand::Rng;
use upcr::{Error, Result, Rigid};

use crate::random;

/// A pinhole depth camera; its frame has x to the right, y down and z along the view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthCamera {
    /// Columns of the image.
    pub width: usize,
    /// Rows of the image.
    pub height: usize,
    /// Focal lengths in px, horizontal and vertical.
    pub focal_px: [f64; 2],
    /// Principal point in px, column and row, pixel centres at whole numbers.
    pub center_px: [f64; 2],
}

/// A spinning lidar; its frame has x forward, y to the left and z up, along the axis of rotation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lidar {
    /// Number of lasers, spread evenly over the elevation range.
    pub beams: usize,
    /// Measurements of each laser in a full turn.
    pub azimuth_steps: usize,
    /// Elevation of the lowest and of the highest laser, in degrees above the horizontal.
    pub elevation_deg: [f64; 2],
}

/// The rays of a sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Optics {
    /// A pinhole depth camera.
    DepthCamera(DepthCamera),
    /// A spinning lidar.
    Lidar(Lidar),
}

/// A range sensor. Lengths are in the scene's unit, metres for the built-in scenes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sensor {
    /// Its rays.
    pub optics: Optics,
    /// Shortest and longest range along a ray that it measures.
    pub range_m: [f64; 2],
    /// What it makes of a range.
    pub noise: RangeNoise,
}

/// The errors of a range measurement.
///
/// The standard deviation at range `r` is `constant_m + linear * r + quadratic_per_m * r²`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RangeNoise {
    /// Standard deviation at no distance.
    pub constant_m: f64,
    /// Growth of the standard deviation with the range.
    pub linear: f64,
    /// Growth with the square of the range, as in triangulating sensors.
    pub quadratic_per_m: f64,
    /// Probability that a ray returns nothing.
    pub dropout: f64,
    /// Angle between ray and normal in degrees, from which on the probability of no return rises linearly, to
    /// certainty at 90°; at 90 itself none is lost to grazing.
    pub grazing_deg: f64,
    /// Step ranges are rounded to; 0 for none.
    pub quantum_m: f64,
}

impl DepthCamera {
    /// A camera of square pixels with its principal point in the middle of the image.
    pub fn centered(width: usize, height: usize, focal_px: f64) -> Self {
        let center_px = [(width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0];
        Self { width, height, focal_px: [focal_px; 2], center_px }
    }

    /// The same field of view at another resolution.
    #[must_use]
    pub fn resized(&self, width: usize, height: usize) -> Self {
        let scale = [width as f64 / self.width as f64, height as f64 / self.height as f64];
        Self {
            width,
            height,
            focal_px: [0, 1].map(|i| self.focal_px[i] * scale[i]),
            center_px: [0, 1].map(|i| (self.center_px[i] + 0.5) * scale[i] - 0.5),
        }
    }
}

impl Lidar {
    fn elevation_step_deg(&self) -> f64 {
        (self.elevation_deg[1] - self.elevation_deg[0]) / (self.beams.max(2) - 1) as f64
    }
}

impl RangeNoise {
    /// No error at all.
    pub const NONE: Self = Self {
        constant_m: 0.0,
        linear: 0.0,
        quadratic_per_m: 0.0,
        dropout: 0.0,
        grazing_deg: 90.0,
        quantum_m: 0.0,
    };

    /// Standard deviation at `range_m`.
    pub fn sigma_m(&self, range_m: f64) -> f64 {
        self.constant_m + range_m * (self.linear + self.quadratic_per_m * range_m)
    }

    /// What is measured where the truth is `range_m` and the ray meets the normal at `incidence_rad`.
    pub(super) fn measure(&self, range_m: f64, incidence_rad: f64, rng: &mut impl Rng) -> Option<f64> {
        let grazing_rad = self.grazing_deg.to_radians();
        let excess = (incidence_rad - grazing_rad).max(0.0) / (FRAC_PI_2 - grazing_rad).max(f64::EPSILON);
        let lost = rng.random_bool(self.dropout) | (self.grazing_deg < 90.0 && rng.random::<f64>() < excess);
        let measured = range_m + self.sigma_m(range_m) * random::normal(rng);
        let rounded = if self.quantum_m > 0.0 {
            (measured / self.quantum_m).round() * self.quantum_m
        } else {
            measured
        };
        (!lost && rounded > 0.0).then_some(rounded)
    }

    fn check(&self) -> Result<()> {
        let lengths = [self.constant_m, self.linear, self.quadratic_per_m, self.quantum_m];
        if !lengths.iter().all(|&v| v.is_finite() && v >= 0.0) {
            return Err(invalid("noise", "must be finite and not negative"));
        }
        if !(0.0..=1.0).contains(&self.dropout) {
            return Err(invalid("dropout", "is a probability, 0 to 1"));
        }
        if !(0.0..=90.0).contains(&self.grazing_deg) {
            return Err(invalid("grazing_deg", "must lie between 0 and 90"));
        }
        Ok(())
    }
}

impl Sensor {
    /// Rows and columns of the scan: pixels, or lasers and azimuth steps.
    pub fn shape(&self) -> [usize; 2] {
        match &self.optics {
            Optics::DepthCamera(camera) => [camera.height, camera.width],
            Optics::Lidar(lidar) => [lidar.beams, lidar.azimuth_steps],
        }
    }

    /// Unit direction of a ray in the sensor's frame.
    pub fn ray(&self, row: usize, column: usize) -> Vector3<f64> {
        match &self.optics {
            Optics::DepthCamera(camera) => {
                let [x, y] = [(0, column), (1, row)]
                    .map(|(i, pixel)| (pixel as f64 - camera.center_px[i]) / camera.focal_px[i]);
                Vector3::new(x, y, 1.0).normalize()
            }
            Optics::Lidar(lidar) => {
                let elevation_deg = lidar.elevation_deg[0] + lidar.elevation_step_deg() * row as f64;
                let (sin_elevation, cos_elevation) = elevation_deg.to_radians().sin_cos();
                let (sin, cos) = (TAU * column as f64 / lidar.azimuth_steps as f64).sin_cos();
                Vector3::new(cos_elevation * cos, cos_elevation * sin, sin_elevation)
            }
        }
    }

    /// Whether a point of the sensor's frame lies within range and field of view.
    pub fn covers(&self, point: &Vector3<f64>) -> bool {
        let range = point.norm();
        let in_view = match &self.optics {
            Optics::DepthCamera(camera) => {
                let size = [camera.width, camera.height];
                let in_axis = |i: usize| {
                    let pixel = point[i] / point.z * camera.focal_px[i] + camera.center_px[i];
                    (-0.5..=size[i] as f64 - 0.5).contains(&pixel)
                };
                point.z > 0.0 && in_axis(0) && in_axis(1)
            }
            Optics::Lidar(lidar) => {
                // Like a pixel, a laser stands for what lies within half a step of it.
                let [low, high] = lidar.elevation_deg;
                let margin = lidar.elevation_step_deg() / 2.0;
                (low - margin..=high + margin).contains(&(point.z / range).asin().to_degrees())
            }
        };
        in_view && (self.range_m[0]..=self.range_m[1]).contains(&range)
    }

    /// Pose `T_world_sensor` of the sensor at `eye` turned toward `forward`, upright about the world's z axis.
    ///
    /// A lidar stays level and only turns toward `forward`.
    pub(super) fn pose(&self, eye: Vector3<f64>, forward: Vector3<f64>) -> Rigid {
        let right = forward.cross(&Vector3::z());
        // Straight up or down there is no upright; any right will do.
        let right = right.try_normalize(1e-9).unwrap_or_else(Vector3::x);
        let rotation = match &self.optics {
            Optics::DepthCamera(_) => {
                let forward = forward.normalize();
                Matrix3::from_columns(&[right, forward.cross(&right), forward])
            }
            Optics::Lidar(_) => Matrix3::from_columns(&[Vector3::z().cross(&right), -right, Vector3::z()]),
        };
        Rigid { rotation, translation: eye }
    }

    /// The same field of view with at most some thousand rays.
    pub(super) fn coarse(&self) -> Self {
        let optics = match &self.optics {
            Optics::DepthCamera(camera) => {
                Optics::DepthCamera(camera.resized(camera.width.min(64), camera.height.min(48)))
            }
            Optics::Lidar(lidar) => Optics::Lidar(Lidar {
                beams: lidar.beams.min(24),
                azimuth_steps: lidar.azimuth_steps.min(128),
                ..*lidar
            }),
        };
        Self { optics, noise: RangeNoise::NONE, ..*self }
    }

    pub(super) fn check(&self) -> Result<()> {
        if self.shape().contains(&0) {
            return Err(invalid("sensor", "casts no ray"));
        }
        match &self.optics {
            Optics::DepthCamera(camera) => {
                if !camera.focal_px.iter().all(|&f| f.is_finite() && f > 0.0)
                    || !camera.center_px.iter().all(|c| c.is_finite())
                {
                    return Err(invalid("focal_px", "focal lengths must be positive, the centre finite"));
                }
            }
            Optics::Lidar(Lidar { elevation_deg: [low, high], .. }) => {
                if !(-90.0 <= *low && low <= high && *high <= 90.0) {
                    return Err(invalid("elevation_deg", "must rise, within -90 to 90"));
                }
            }
        }
        let [near, far] = self.range_m;
        if !(near >= 0.0 && near < far && far.is_finite()) {
            return Err(invalid("range_m", "needs 0 <= nearest < farthest"));
        }
        self.noise.check()
    }
}

pub(super) fn invalid(name: &'static str, reason: &str) -> Error {
    Error::InvalidSetting { name, reason: reason.into() }
}
