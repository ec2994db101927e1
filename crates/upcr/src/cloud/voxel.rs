//! Voxel-grid downsampling: one averaged point per occupied cell.

use crate::PointCloud;

/// Cell coordinates are kept below this so that three of them fit one 64-bit key.
const MAX_CELLS_PER_AXIS: f64 = (1u64 << 21) as f64;

/// Occupied cells of a typical grid: room for so many is made at once.
const TYPICAL_CELLS: usize = 16_384;

/// Points or cells between two looks at whether to go on.
const BLOCK: usize = 8192;

/// What fell into one cell: sums about the grid's corner, and how many points.
///
/// The second moments make the surface normal a by-product of the one pass over the points.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Cell {
    /// Σ p
    pub sum: [f64; 3],
    /// Σ p pᵀ: xx, xy, xz, yy, yz, zz
    pub outer: [f64; 6],
    /// Number of points.
    pub count: f64,
}

impl Cell {
    fn add(&mut self, p: [f64; 3]) {
        self.count += 1.0;
        for k in 0..3 {
            self.sum[k] += p[k];
        }
        let [x, y, z] = p;
        for (s, v) in self.outer.iter_mut().zip([x * x, x * y, x * z, y * y, y * z, z * z]) {
            *s += v;
        }
    }

    /// Adds what another cell holds.
    pub fn merge(&mut self, other: &Self) {
        self.count += other.count;
        for k in 0..3 {
            self.sum[k] += other.sum[k];
        }
        for k in 0..6 {
            self.outer[k] += other.outer[k];
        }
    }

    /// Covariance of the points: xx, xy, xz, yy, yz, zz.
    pub fn covariance(&self) -> [f64; 6] {
        let [x, y, z] = self.mean();
        let square = [x * x, x * y, x * z, y * y, y * z, z * z];
        std::array::from_fn(|k| self.outer[k] / self.count - square[k])
    }

    /// Mean of the points.
    pub fn mean(&self) -> [f64; 3] {
        self.sum.map(|s| s / self.count)
    }
}

/// Occupied cells of a regular grid, in the order in which the points first entered them.
#[derive(Debug, Clone)]
pub(crate) struct VoxelGrid {
    /// The occupied cells.
    pub cells: Vec<Cell>,
    keys: Vec<u64>,
    table: CellTable,
}

/// The smallest voxel a grid over a cloud of this extent can have.
pub(crate) fn smallest_voxel_size(extent: f64) -> f64 {
    extent / (MAX_CELLS_PER_AXIS - 3.0)
}

impl VoxelGrid {
    /// Sorts `points`, shifted by `-origin`, into cells of edge `voxel_size`; `corner` is the lowest corner
    /// of the shifted points. `None` where they occupy more than `most` cells; as long as `go_on`, asked now and then,
    /// has nothing against it.
    pub fn new<E>(
        points: impl Iterator<Item = [f64; 3]>,
        origin: [f64; 3],
        corner: [f64; 3],
        voxel_size: f64,
        most: usize,
        go_on: impl Fn() -> Result<(), E>,
    ) -> Result<Option<Self>, E> {
        let mut grid = Self {
            cells: Vec::with_capacity(TYPICAL_CELLS),
            keys: Vec::with_capacity(TYPICAL_CELLS),
            table: CellTable::with_capacity(2 * TYPICAL_CELLS),
        };
        let scale = 1.0 / voxel_size;
        let (mut last_key, mut last_cell) = (EMPTY, 0);
        for (i, p) in points.enumerate() {
            if i.is_multiple_of(BLOCK) {
                go_on()?;
            }
            let local = [p[0] - origin[0], p[1] - origin[1], p[2] - origin[2]];
            let key = key_of(std::array::from_fn(|k| ((local[k] - corner[k]) * scale) as u64));
            // Neighbouring points of a scan mostly share a cell.
            if key != last_key {
                last_cell = grid.table.entry(key, grid.cells.len() as u32) as usize;
                last_key = key;
                if last_cell == grid.cells.len() {
                    if last_cell == most {
                        return Ok(None);
                    }
                    grid.cells.push(Cell::default());
                    grid.keys.push(key);
                }
            }
            grid.cells[last_cell].add(local);
        }
        Ok(Some(grid))
    }

    /// The grid of twice the voxel size, its cells the sums of up to eight of this grid's, in the same memory.
    pub fn coarsened<E>(mut self, go_on: impl Fn() -> Result<(), E>) -> Result<Self, E> {
        self.table.clear();
        let mut len = 0;
        for i in 0..self.cells.len() {
            if i.is_multiple_of(BLOCK) {
                go_on()?;
            }
            // A cell is met before any behind it needs its place.
            let (cell, key) = (self.cells[i], key_of(unpack(self.keys[i]).map(|c| (c - 1) / 2)));
            let at = self.table.entry(key, len as u32) as usize;
            if at == len {
                self.cells[at] = Cell::default();
                self.keys[at] = key;
                len += 1;
            }
            self.cells[at].merge(&cell);
        }
        self.cells.truncate(len);
        self.keys.truncate(len);
        Ok(self)
    }

    /// Moments of cell `i` and the occupied ones of the six that share a face with it.
    pub fn surroundings(&self, i: usize) -> Cell {
        let mut sum = self.cells[i];
        let [x, y, z] = unpack(self.keys[i]);
        // Keys are stored one up (see `key_of`), so one below never wraps.
        for near in [[x - 1, y, z], [x + 1, y, z], [x, y - 1, z], [x, y + 1, z], [x, y, z - 1], [x, y, z + 1]]
        {
            if let Some(j) = self.table.get(pack(near)) {
                sum.merge(&self.cells[j as usize]);
            }
        }
        sum
    }
}

/// Number of cells of edge `voxel_size` that `points` occupy.
pub(crate) fn count_occupied(points: &[[f64; 3]], corner: [f64; 3], voxel_size: f64) -> usize {
    let mut table = CellTable::with_capacity(4096);
    let scale = 1.0 / voxel_size;
    let mut count = 0;
    for p in points {
        let key = key_of(std::array::from_fn(|k| ((p[k] - corner[k]) * scale) as u64));
        if table.entry(key, count) == count {
            count += 1;
        }
    }
    count as usize
}

impl PointCloud {
    /// One point per occupied cell of a grid of edge `voxel_size`: the mean of the cell's points, colours
    /// and normals, in the order in which the cells are first met.
    ///
    /// # Errors
    /// [`crate::Error::InvalidSetting`] where `voxel_size` is not positive or the cloud is over 2²¹ cells wide;
    /// [`crate::Error::NonFinite`] where a coordinate is not finite.
    pub fn voxel_downsample(&self, voxel_size: f64) -> crate::Result<Self> {
        let bounds = self.checked_bounds(crate::CloudRole::Cloud)?;
        if !(voxel_size.is_finite() && voxel_size > 0.0) {
            return Err(crate::Error::InvalidSetting {
                name: "voxel_size",
                reason: format!("must be a positive length, not {voxel_size}"),
            });
        }
        let Some(bounds) = bounds else { return Ok(self.clone()) };
        let extent = bounds.extent().into_iter().fold(0.0, f64::max);
        if voxel_size < smallest_voxel_size(extent) {
            return Err(crate::Error::InvalidSetting {
                name: "voxel_size",
                reason: format!(
                    "{voxel_size} cuts the cloud's extent of {extent} into more than 2097148 cells an axis"
                ),
            });
        }
        let scale = 1.0 / voxel_size;
        let mut table = CellTable::with_capacity(4096);
        let mut means: Vec<Mean> = Vec::new();
        for (i, p) in self.points.iter().enumerate() {
            let local: [f64; 3] = std::array::from_fn(|k| p[k] - bounds.min[k]);
            let cell = table.entry(key_of(local.map(|v| (v * scale) as u64)), means.len() as u32) as usize;
            if cell == means.len() {
                means.push(Mean::default());
            }
            let mean = &mut means[cell];
            mean.count += 1.0;
            for k in 0..3 {
                mean.point[k] += local[k];
                mean.normal[k] += self.normals.as_ref().map_or(0.0, |n| n[i][k]);
                mean.color[k] += self.colors.as_ref().map_or(0.0, |c| f32::from(c[i][k]));
            }
        }
        let unit = |n: [f32; 3]| {
            let length = n.iter().map(|v| v * v).sum::<f32>().sqrt();
            if length > 0.0 { n.map(|v| v / length) } else { n }
        };
        Ok(Self {
            points: means
                .iter()
                .map(|m| std::array::from_fn(|k| m.point[k] / m.count + bounds.min[k]))
                .collect(),
            normals: self.normals.as_ref().map(|_| means.iter().map(|m| unit(m.normal)).collect()),
            colors: self
                .colors
                .as_ref()
                .map(|_| means.iter().map(|m| m.color.map(|c| (c / m.count as f32).round() as u8)).collect()),
            viewpoint: self.viewpoint,
        })
    }
}

/// Running sums of one cell's points and what they carry.
#[derive(Default)]
struct Mean {
    point: [f64; 3],
    normal: [f32; 3],
    color: [f32; 3],
    count: f64,
}

const EMPTY: u64 = u64::MAX;

/// Cell coordinates to a key; each is moved up by one so that a cell's lower neighbours have keys too.
fn key_of(cell: [u64; 3]) -> u64 {
    pack(cell.map(|c| c + 1))
}

fn pack(cell: [u64; 3]) -> u64 {
    cell[0] | cell[1] << 21 | cell[2] << 42
}

fn unpack(key: u64) -> [u64; 3] {
    let mask = (1 << 21) - 1;
    [key & mask, key >> 21 & mask, key >> 42 & mask]
}

/// Open-addressing map from cell keys to consecutive numbers.
#[derive(Debug, Clone)]
struct CellTable {
    slots: Vec<(u64, u32)>,
    len: usize,
}

impl CellTable {
    fn with_capacity(slots: usize) -> Self {
        Self { slots: vec![(EMPTY, 0); slots.next_power_of_two()], len: 0 }
    }

    fn clear(&mut self) {
        self.slots.fill((EMPTY, 0));
        self.len = 0;
    }

    fn slot(&self, key: u64) -> usize {
        let mask = self.slots.len() - 1;
        // Fibonacci hashing; the high bits are the well mixed ones.
        let mut at = (key.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 32) as usize & mask;
        while self.slots[at].0 != key && self.slots[at].0 != EMPTY {
            at = (at + 1) & mask;
        }
        at
    }

    /// The number stored under `key`; `new` is stored and returned where there is none.
    fn entry(&mut self, key: u64, new: u32) -> u32 {
        let mut at = self.slot(key);
        if self.slots[at].0 == EMPTY {
            if self.len * 2 >= self.slots.len() {
                let doubled = vec![(EMPTY, 0); self.slots.len() * 2];
                let old = std::mem::replace(&mut self.slots, doubled);
                for entry in old.into_iter().filter(|e| e.0 != EMPTY) {
                    let to = self.slot(entry.0);
                    self.slots[to] = entry;
                }
                at = self.slot(key);
            }
            self.slots[at] = (key, new);
            self.len += 1;
        }
        self.slots[at].1
    }

    fn get(&self, key: u64) -> Option<u32> {
        let (found, value) = self.slots[self.slot(key)];
        (found == key).then_some(value)
    }
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use super::*;

    #[test]
    fn a_cell_gives_the_mean_of_what_it_holds() {
        let cloud = PointCloud {
            points: vec![[1e6, 0.0, 0.0], [1e6 + 0.5, 0.0, 0.0], [1e6 + 2.5, 0.0, 0.0]],
            normals: Some(vec![[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
            colors: Some(vec![[10, 0, 0], [20, 0, 0], [90, 80, 70]]),
            viewpoint: Some([0.0; 3]),
        };
        let thin = cloud.voxel_downsample(1.0).unwrap();
        assert_eq!(thin.points, [[1e6 + 0.25, 0.0, 0.0], [1e6 + 2.5, 0.0, 0.0]]);
        assert_eq!(thin.colors.unwrap(), [[15, 0, 0], [90, 80, 70]]);
        let half = 0.5f32.sqrt();
        let normals = thin.normals.unwrap();
        assert!(normals[0].iter().zip([0.0, half, half]).all(|(a, b)| (a - b).abs() < 1e-6), "{normals:?}");
        assert_eq!(normals[1], [1.0, 0.0, 0.0]);
    }

    #[test]
    fn unusable_sizes_are_refused() {
        let cloud = PointCloud::from_points(vec![[0.0; 3], [1.0; 3]]);
        for size in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e-9] {
            assert!(cloud.voxel_downsample(size).is_err(), "{size}");
        }
    }

    #[test]
    fn coarse_cells_are_sums_of_fine_ones() {
        let points: Vec<[f64; 3]> =
            (0..5000).map(|i| [(i * 37 % 101) as f64, (i * 53 % 97) as f64, (i * 11 % 89) as f64]).collect();
        let up_to = |most, size| {
            VoxelGrid::new(points.iter().copied(), [0.0; 3], [0.0; 3], size, most, || Ok::<_, Infallible>(()))
                .unwrap()
        };
        let grid = |size| up_to(points.len(), size).unwrap();
        let (coarsened, direct) = (grid(4.0).coarsened(|| Ok::<_, Infallible>(())).unwrap(), grid(8.0));
        assert_eq!(coarsened.keys, direct.keys);
        for (a, b) in coarsened.cells.iter().zip(&direct.cells) {
            assert_eq!((a.sum, a.outer, a.count), (b.sum, b.outer, b.count));
        }
        let count = direct.cells.len();
        assert_eq!(count, count_occupied(&points, [0.0; 3], 8.0));
        assert!(up_to(count, 8.0).is_some() && up_to(count - 1, 8.0).is_none());
    }
}
