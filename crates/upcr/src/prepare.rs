//! First step of the pipeline: check a cloud once, shift it to a local origin, choose the scale, downsample.

use std::borrow::Cow;

use rayon::prelude::*;

use crate::{
    CloudRole, Error, PointCloud,
    cloud::{
        Bounds, fit_plane, local, nearest_planes, plane_normal,
        voxel::{Cell, VoxelGrid, count_occupied, smallest_voxel_size},
    },
    neighbors::{KdTree, Neighborhoods},
    watch::{Call, IsOver, Stop},
};

/// Points that carry features: enough to describe a room, few enough to match in milliseconds.
const FEATURE_POINTS: usize = 2000;
/// The most points that may carry features where the user's voxel size asks for more.
const MAX_FEATURE_POINTS: usize = 6000;
/// Points looked at to choose the scale.
const SCALE_SAMPLE: usize = 8192;
/// Points at which the spacing of a small cloud is measured.
const SPACING_SAMPLE: usize = 256;
/// Reach of a feature.
const FEATURE_RADIUS_VOXELS: f32 = 5.0;
/// Neighbours that a feature looks at, at most.
const FEATURE_NEIGHBORS: usize = 48;
/// Neighbours of a normal where cells are too sparse to give it: the nearest of them.
const NORMAL_NEIGHBORS: usize = 16;
/// Mean points a cell from which on cells give normals.
const DENSE_CELL: f64 = 3.0;
/// Points without which no pose is determined.
const FEWEST_POINTS: usize = 3;
/// Every so-many-th point is kept from the refinement and used by the verification alone.
const HOLD_OUT_EVERY: u32 = 4;
/// Clouds of fewer points can spare none.
const HOLD_OUT_FROM: usize = 100;

/// Whether a registration describes points by features.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Described {
    /// It does not.
    Never,
    /// It may have to, later.
    Perhaps,
    /// It does, first of all.
    Surely,
}

/// A cloud that passed the checks, with the numbers that later steps need.
pub(crate) struct Checked<'a> {
    pub cloud: &'a PointCloud,
    pub bounds: Bounds,
    role: CloudRole,
    /// Every so-many-th point is used.
    step: usize,
}

impl Checked<'_> {
    /// The points that are used.
    fn points(&self) -> impl ExactSizeIterator<Item = [f64; 3]> {
        self.cloud.points.iter().step_by(self.step).copied()
    }

    /// The same, about the local origin.
    fn local_points(&self) -> Vec<[f32; 3]> {
        let origin = self.bounds.center();
        self.points().map(|p| local(p, origin)).collect()
    }

    /// How many they are.
    pub fn len(&self) -> usize {
        self.cloud.len().div_ceil(self.step)
    }

    /// Uses half as many from now on.
    pub fn thin(&mut self) {
        self.step *= 2;
    }
}

/// A cloud at one resolution, about its local origin.
pub(crate) struct Level {
    pub points: Vec<[f32; 3]>,
    /// Unit normals of arbitrary sign.
    pub normals: Vec<[f32; 3]>,
    pub tree: KdTree,
    pub voxel_size: f32,
    /// Largest distance of a point from the local origin.
    pub radius: f32,
    /// Whether the points are samples as they were taken, not averages of many.
    pub sparse: bool,
    /// Whether there is one point a cell, so that none of the surface is far from one.
    pub gridded: bool,
    /// Neighbourhoods that features look at, where they were needed already.
    graph: Option<Neighborhoods>,
}

/// A cloud ready to be registered.
pub(crate) struct Prepared {
    /// Local coordinates are the file's minus this.
    pub origin: [f64; 3],
    /// Where the sensor stood, about the local origin, where that is known.
    pub viewpoint: Option<[f32; 3]>,
    /// Length of the bounding box's diagonal.
    pub diagonal: f32,
    /// Points of the cloud that were looked at.
    pub points_used: usize,
    /// Resolution of refinement and verification.
    pub fine: Level,
    /// Resolution of the features, where it differs from `fine` and features are wanted.
    coarse: Option<Level>,
}

impl Prepared {
    /// Resolution of the features.
    pub fn coarse(&self) -> &Level {
        self.coarse.as_ref().unwrap_or(&self.fine)
    }

    /// Indices into `fine` of the points that the refinement moves.
    pub fn refined_points(&self) -> Vec<u32> {
        let all = 0..self.fine.points.len() as u32;
        if all.len() < HOLD_OUT_FROM { all.collect() } else { all.filter(|i| !is_held_out(*i)).collect() }
    }

    /// Indices into `fine` of the points that only the verification sees.
    ///
    /// Of a cloud too small to spare any, all points: they then serve both.
    pub fn held_out_points(&self) -> Vec<u32> {
        let all = 0..self.fine.points.len() as u32;
        if all.len() < HOLD_OUT_FROM { all.collect() } else { all.filter(|i| is_held_out(*i)).collect() }
    }
}

/// A fixed pseudo-random quarter of all indices.
fn is_held_out(index: u32) -> bool {
    // A stride would follow scan lines; the hash does not.
    (index.wrapping_mul(0x9E37_79B9) >> 16).is_multiple_of(HOLD_OUT_EVERY)
}

/// Checks that `cloud` is finite, large enough and more than a line.
pub(crate) fn check<'a>(cloud: &'a PointCloud, role: CloudRole, call: &Call) -> Result<Checked<'a>, Stop> {
    let bounds = cloud.checked_bounds_while(role, || call.go_on())?;
    let (Some(bounds), FEWEST_POINTS..) = (bounds, cloud.len()) else {
        return Err(Error::TooFewPoints { role, found: cloud.len(), needed: FEWEST_POINTS }.into());
    };
    let degenerate = |reason| Err(Error::Degenerate { role, reason }.into());
    if bounds.diagonal() == 0.0 {
        return degenerate("all points are equal");
    }
    if !bounds.diagonal().is_finite() || bounds.diagonal() > f64::from(f32::MAX).sqrt() {
        return degenerate("the coordinates are too far apart to compute with");
    }
    if is_collinear(cloud, &bounds) {
        return degenerate("all points lie on one line");
    }
    Ok(Checked { cloud, bounds, role, step: 1 })
}

/// Whether no point leaves the line through the first point and the one most distant from it.
fn is_collinear(cloud: &PointCloud, bounds: &Bounds) -> bool {
    const TOLERANCE: f64 = 1e-6;
    let limit = TOLERANCE * bounds.diagonal();
    // A few points mostly settle it.
    let few: Vec<[f64; 3]> = cloud.points.iter().step_by(cloud.len().div_ceil(100)).copied().collect();
    on_a_line(&few, limit) && on_a_line(&cloud.points, limit)
}

fn on_a_line(points: &[[f64; 3]], limit: f64) -> bool {
    let first = points[0];
    let minus = |a: [f64; 3], b: [f64; 3]| [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    let norm_sq = |v: [f64; 3]| v.iter().map(|x| x * x).sum::<f64>();
    let mut far = [0.0; 3];
    for &p in points {
        let d = minus(p, first);
        if norm_sq(d) > norm_sq(far) {
            far = d;
        }
    }
    let length_sq = norm_sq(far).max(f64::MIN_POSITIVE);
    points.iter().all(|&p| {
        let d = minus(p, first);
        let along = (d[0] * far[0] + d[1] * far[1] + d[2] * far[2]) / length_sq;
        norm_sq(std::array::from_fn(|k| d[k] - along * far[k])) <= limit * limit
    })
}

/// The scale of both clouds: their point spacing, or coarser where that leaves more points than features need.
pub(crate) fn derive_voxel_size(source: &Checked, target: &Checked) -> f64 {
    let (a, b) = rayon::join(|| natural_voxel_size(source), || natural_voxel_size(target));
    a.max(b)
}

pub(crate) fn natural_voxel_size(checked: &Checked) -> f64 {
    let (points, bounds) = (checked.len(), &checked.bounds);
    let floor = smallest_voxel_size(bounds.diagonal());
    if points <= FEATURE_POINTS {
        return spacing(checked).max(floor);
    }
    let sample: Vec<_> = checked.points().step_by(points.div_ceil(SCALE_SAMPLE)).collect();
    // Scans are surfaces: the number of occupied cells falls with the square of their size.
    let mut coarse = bounds.diagonal() / 64.0;
    let mut occupied = 0;
    for _ in 0..6 {
        occupied = count_occupied(&sample, bounds.min, coarse.max(floor)).max(1);
        let ratio = occupied as f64 / FEATURE_POINTS as f64;
        if (0.95..1.05).contains(&ratio) {
            break;
        }
        coarse *= ratio.sqrt();
    }
    let spacing = coarse / (points as f64 / occupied as f64).sqrt();
    (0.5 * coarse).max(spacing).max(floor)
}

/// Typical distance between neighbouring samples, as the edge of the square that each would have to itself.
fn spacing(checked: &Checked) -> f64 {
    const NEIGHBORS: usize = 9;
    let points = checked.local_points();
    let tree = KdTree::new(&points);
    let step = points.len().div_ceil(SPACING_SAMPLE);
    let mut found = Vec::new();
    let mut edges: Vec<f32> = points
        .iter()
        .step_by(step)
        .filter_map(|&p| {
            tree.knn(p, NEIGHBORS, &mut found);
            // πr² holds as many points as were found, the point itself apart.
            let last = found.last()?;
            Some((std::f32::consts::PI * last.distance_sq / (found.len().max(2) - 1) as f32).sqrt())
        })
        .filter(|&edge| edge > 0.0)
        .collect();
    if edges.is_empty() {
        return checked.bounds.diagonal() / (points.len() as f64).sqrt();
    }
    let middle = edges.len() / 2;
    f64::from(*edges.select_nth_unstable_by(middle, f32::total_cmp).1)
}

/// Downsamples to `voxel_size`, to `most` points at most, and, where features are wanted, to the resolution that carries
/// them.
pub(crate) fn prepare(
    checked: &Checked,
    voxel_size: f64,
    described: Described,
    most: usize,
    call: &Call,
) -> Result<Prepared, Stop> {
    let (bounds, points_used) = (&checked.bounds, checked.len());
    if voxel_size < smallest_voxel_size(bounds.diagonal()) {
        return Err(Error::InvalidSetting {
            name: "voxel_size",
            reason: format!(
                "{voxel_size} is too small for the {}'s extent of {}",
                checked.role,
                bounds.diagonal()
            ),
        }
        .into());
    }
    let go_on = || call.go_on();
    let origin = bounds.center();
    let viewpoint = checked.cloud.viewpoint.map(|v| local(v, origin));
    let viewpoint = viewpoint.filter(|v| v.iter().all(|c| c.is_finite()));
    let diagonal = bounds.diagonal() as f32;
    let corner = std::array::from_fn(|k| bounds.min[k] - origin[k]);
    let grid = VoxelGrid::new(checked.points(), origin, corner, voxel_size, most, go_on)?;
    let mut grid = grid.ok_or(Stop::Full)?;
    if points_used <= FEATURE_POINTS && grid.cells.len() * 10 >= points_used * 4 {
        // The scale is the cloud's own spacing: keep the samples themselves.
        let fine = Level::sparse(checked.local_points(), voxel_size, described, call)?;
        return Ok(Prepared { origin, viewpoint, diagonal, points_used, fine, coarse: None });
    }
    let separate = described != Described::Never && grid.cells.len() > FEATURE_POINTS;
    let fine_described = if separate { Described::Never } else { described };
    let fine = Level::from_grid(&grid, voxel_size, fine_described, call)?;
    let mut coarse = None;
    if separate {
        let mut size = voxel_size;
        while size == voxel_size || grid.cells.len() > MAX_FEATURE_POINTS {
            grid = grid.coarsened(go_on)?;
            size *= 2.0;
        }
        coarse = Some(Level::from_grid(&grid, size, described, call)?);
    }
    Ok(Prepared { origin, viewpoint, diagonal, points_used, fine, coarse })
}

impl Level {
    /// Every point as it is, normals from its nearest neighbours.
    fn sparse(
        points: Vec<[f32; 3]>,
        voxel_size: f64,
        described: Described,
        call: &Call,
    ) -> Result<Self, Stop> {
        let is_over = || call.is_over();
        let tree = KdTree::new_unless(&points, &is_over);
        call.go_on()?;
        let (graph, normals) = if described == Described::Surely {
            let graph = feature_graph(&tree, voxel_size as f32, &is_over);
            let planes = nearest_planes(&points, &graph, NORMAL_NEIGHBORS);
            (Some(graph), planes.iter().map(|p| p.normal).collect())
        } else {
            let normal = |i: usize, nearest: &[_]| fit_plane(&points, points[i], nearest).normal;
            (None, tree.map_nearest(NORMAL_NEIGHBORS, &is_over, normal))
        };
        call.go_on()?;
        Ok(Self { sparse: true, graph, ..Self::new(points, normals, tree, voxel_size) })
    }

    /// One point a cell, normals from the points in and around it.
    fn from_grid(grid: &VoxelGrid, voxel_size: f64, described: Described, call: &Call) -> Result<Self, Stop> {
        let points: Vec<[f32; 3]> = grid.cells.iter().map(|c| c.mean().map(|v| v as f32)).collect();
        let total: f64 = grid.cells.iter().map(|c| c.count).sum();
        if total < DENSE_CELL * points.len() as f64 {
            return Ok(Self { gridded: true, ..Self::sparse(points, voxel_size, described, call)? });
        }
        let (tree, normals) = rayon::join(
            || KdTree::new_unless(&points, &|| call.is_over()),
            || {
                (0..points.len())
                    .into_par_iter()
                    .with_min_len(256)
                    .map(|i| if call.is_over() { [0.0; 3] } else { normal_of(&grid.surroundings(i)) })
                    .collect::<Vec<_>>()
            },
        );
        call.go_on()?;
        Ok(Self { gridded: true, ..Self::new(points, normals, tree, voxel_size) })
    }

    fn new(points: Vec<[f32; 3]>, normals: Vec<[f32; 3]>, tree: KdTree, voxel_size: f64) -> Self {
        let radius_sq = points.iter().map(|p| p.iter().map(|v| v * v).sum::<f32>()).fold(0.0, f32::max);
        Self {
            points,
            normals,
            tree,
            voxel_size: voxel_size as f32,
            radius: radius_sq.sqrt(),
            sparse: false,
            gridded: false,
            graph: None,
        }
    }

    /// Neighbourhoods that features look at.
    ///
    /// Of no use where `is_over`, asked now and then, said yes.
    pub fn feature_graph(&self, is_over: IsOver) -> Cow<'_, Neighborhoods> {
        match &self.graph {
            Some(graph) => Cow::Borrowed(graph),
            None => Cow::Owned(feature_graph(&self.tree, self.voxel_size, is_over)),
        }
    }

    /// At most `count` of all point indices.
    pub fn spread(&self, count: usize) -> Vec<u32> {
        let all = 0..self.points.len() as u32;
        let step = all.len().div_ceil(count.max(1)).max(1);
        all.step_by(step).collect()
    }

    /// At most `count` point indices, spread evenly over `indices`.
    pub fn thin(indices: &[u32], count: usize) -> Vec<u32> {
        let step = indices.len().div_ceil(count.max(1)).max(1);
        indices.iter().step_by(step).copied().collect()
    }
}

fn feature_graph(tree: &KdTree, voxel_size: f32, is_over: IsOver) -> Neighborhoods {
    tree.radius_graph_unless(FEATURE_RADIUS_VOXELS * voxel_size, FEATURE_NEIGHBORS, is_over)
}

fn normal_of(cell: &Cell) -> [f32; 3] {
    plane_normal(&cell.covariance())
}
