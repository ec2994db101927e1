//! Bounding box, and the check that every coordinate is a number.

use crate::{CloudRole, Error, PointCloud, Result};

/// Points checked between two looks at whether to go on.
const BLOCK: usize = 1 << 16;

/// Axis-aligned bounding box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Lowest corner.
    pub min: [f64; 3],
    /// Highest corner.
    pub max: [f64; 3],
}

impl Bounds {
    /// Midpoint.
    pub fn center(&self) -> [f64; 3] {
        std::array::from_fn(|k| self.min[k] + 0.5 * (self.max[k] - self.min[k]))
    }

    /// Edge lengths.
    pub fn extent(&self) -> [f64; 3] {
        std::array::from_fn(|k| self.max[k] - self.min[k])
    }

    /// Length of the diagonal.
    pub fn diagonal(&self) -> f64 {
        self.extent().iter().map(|e| e * e).sum::<f64>().sqrt()
    }
}

impl PointCloud {
    /// Bounding box of the points, `None` for an empty cloud.
    ///
    /// # Errors
    /// [`Error::NonFinite`], naming `role`, where a coordinate is NaN or infinite.
    pub fn checked_bounds(&self, role: CloudRole) -> Result<Option<Bounds>> {
        self.checked_bounds_while(role, || Ok(()))
    }

    /// As [`Self::checked_bounds`], as long as `go_on`, asked now and then, has nothing against it.
    pub(crate) fn checked_bounds_while<E: From<Error>>(
        &self,
        role: CloudRole,
        go_on: impl Fn() -> Result<(), E>,
    ) -> Result<Option<Bounds>, E> {
        let (mut min, mut max) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        let mut finite = true;
        for block in self.points.chunks(BLOCK) {
            go_on()?;
            for p in block {
                for k in 0..3 {
                    min[k] = min[k].min(p[k]);
                    max[k] = max[k].max(p[k]);
                    finite &= p[k].is_finite();
                }
            }
        }
        if !finite {
            let bad = |p: &&[f64; 3]| p.iter().any(|v| !v.is_finite());
            return Err(Error::NonFinite {
                role,
                count: self.points.iter().filter(bad).count(),
                first: self.points.iter().position(|p| bad(&p)).unwrap_or(0),
            }
            .into());
        }
        Ok((!self.is_empty()).then_some(Bounds { min, max }))
    }

    /// The cloud without the points that have a NaN or infinite coordinate.
    #[must_use]
    pub fn finite(&self) -> Self {
        let kept: Vec<usize> =
            (0..self.len()).filter(|&i| self.points[i].iter().all(|v| v.is_finite())).collect();
        self.select(&kept)
    }
}
