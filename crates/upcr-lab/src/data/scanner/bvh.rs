//! Ray casting against a triangle mesh through a bounding volume hierarchy.

use nalgebra::Vector3;
use upcr::{CloudRole, Error, Result, TriangleMesh};

/// Bins a node's centroids are sorted into when its split is chosen.
const BINS: usize = 16;
/// Triangles a leaf holds at most, unless their centroids coincide in the last bits.
const LEAF_SIZE: usize = 4;
/// Depth from which on nodes are halved by count, which bounds the depth of the whole tree.
const BALANCED_DEPTH: usize = 40;
/// Pending nodes of a traversal: one a level, and halving `u32::MAX` triangles takes 32 levels.
const STACK_SIZE: usize = BALANCED_DEPTH + 33;
/// Slack on barycentric coordinates, so that no ray slips between two triangles sharing an edge.
const EDGE_SLACK: f64 = 1e-9;

/// A mesh indexed for ray casting; both sides of a triangle stop a ray.
///
/// Splits minimise the surface area heuristic over binned centroids along the longest axis.
#[derive(Debug, Clone)]
pub struct Bvh {
    nodes: Vec<Node>,
    triangles: Vec<Triangle>,
}

/// Where a ray meets the mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Distance from the ray's origin, in the mesh's unit.
    pub range: f64,
    /// Unit normal of the triangle, on the side the ray came from.
    pub normal: Vector3<f64>,
    /// Index of the triangle in the mesh.
    pub triangle: usize,
}

/// A box and either two children (`count` 0, at `first` and `first + 1`) or a run of triangles.
#[derive(Debug, Clone, Copy)]
struct Node {
    bounds: Aabb,
    first: u32,
    count: u32,
}

#[derive(Debug, Clone, Copy)]
struct Triangle {
    corner: Vector3<f64>,
    edges: [Vector3<f64>; 2],
    index: u32,
}

/// Axis-aligned bounding box.
#[derive(Debug, Clone, Copy)]
pub(super) struct Aabb {
    pub(super) low: Vector3<f64>,
    pub(super) high: Vector3<f64>,
}

impl Aabb {
    const EMPTY: Self = Self {
        low: Vector3::new(f64::INFINITY, f64::INFINITY, f64::INFINITY),
        high: Vector3::new(f64::NEG_INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY),
    };

    fn around(points: impl IntoIterator<Item = Vector3<f64>>) -> Self {
        points.into_iter().fold(Self::EMPTY, |b, p| Self { low: b.low.inf(&p), high: b.high.sup(&p) })
    }

    fn union(&self, other: &Self) -> Self {
        Self { low: self.low.inf(&other.low), high: self.high.sup(&other.high) }
    }

    fn half_area(&self) -> f64 {
        let d = self.high - self.low;
        if d.x < 0.0 { 0.0 } else { d.x * d.y + d.y * d.z + d.z * d.x }
    }

    /// Range at which the ray enters the box, where it does so before `max_range`.
    fn entry(&self, origin: &Vector3<f64>, inverse: &Vector3<f64>, max_range: f64) -> Option<f64> {
        let (mut enter, mut leave) = (0.0_f64, max_range);
        for axis in 0..3 {
            let a = (self.low[axis] - origin[axis]) * inverse[axis];
            let b = (self.high[axis] - origin[axis]) * inverse[axis];
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        (enter <= leave * (1.0 + 4.0 * f64::EPSILON)).then_some(enter)
    }
}

impl Triangle {
    fn corners(&self) -> [Vector3<f64>; 3] {
        [self.corner, self.corner + self.edges[0], self.corner + self.edges[1]]
    }

    fn centroid(&self) -> Vector3<f64> {
        self.corner + (self.edges[0] + self.edges[1]) / 3.0
    }

    /// Range at which the ray meets the triangle (Möller–Trumbore), from either side.
    fn range(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> Option<f64> {
        let [e1, e2] = &self.edges;
        let p = direction.cross(e2);
        let determinant = e1.dot(&p);
        if determinant == 0.0 {
            return None;
        }
        let s = origin - self.corner;
        let u = s.dot(&p) / determinant;
        let q = s.cross(e1);
        let v = direction.dot(&q) / determinant;
        let inside = u >= -EDGE_SLACK && v >= -EDGE_SLACK && u + v <= 1.0 + EDGE_SLACK;
        let range = e2.dot(&q) / determinant;
        (inside && range > 0.0).then_some(range)
    }
}

impl Bvh {
    /// Indexes a mesh of at least one triangle.
    ///
    /// # Errors
    /// Where there is no triangle, an index names no vertex, or a vertex is not finite.
    pub fn new(mesh: &TriangleMesh) -> Result<Self> {
        let bad = |v: &[f64; 3]| !v.iter().all(|c| c.is_finite());
        if let Some(first) = mesh.vertices.iter().position(bad) {
            let count = mesh.vertices.iter().filter(|v| bad(v)).count();
            return Err(Error::NonFinite { role: CloudRole::Cloud, count, first });
        }
        if mesh.triangles.is_empty() {
            return Err(Error::Degenerate { role: CloudRole::Cloud, reason: "the mesh has no triangles" });
        }
        let vertex = |i: u32| mesh.vertices.get(i as usize).map(|&v| Vector3::from(v));
        let triangle = |(index, t): (usize, &[u32; 3])| {
            let (corner, b, c) = (vertex(t[0])?, vertex(t[1])?, vertex(t[2])?);
            Some(Triangle { corner, edges: [b - corner, c - corner], index: index as u32 })
        };
        let triangles = mesh.triangles.iter().enumerate().map(triangle).collect::<Option<Vec<_>>>();
        let Some(mut triangles) = triangles else {
            return Err(Error::Degenerate {
                role: CloudRole::Cloud,
                reason: "a triangle of the mesh names a missing vertex",
            });
        };
        let nodes = build(&mut triangles);
        Ok(Self { nodes, triangles })
    }

    /// The first triangle met within `max_range` by the ray from `origin` along the unit vector `direction`.
    pub fn cast(&self, origin: &Vector3<f64>, direction: &Vector3<f64>, max_range: f64) -> Option<Hit> {
        // No infinities: with 0 · ∞ a ray within a box's face would miss the box.
        let inverse = direction.map(|d| if d.abs() < 1e-200 { 1e200 } else { d.recip() });
        let mut nearest: Option<(f64, &Triangle)> = None;
        let mut limit = max_range;
        let mut pending = [(0_u32, 0.0_f64); STACK_SIZE];
        let mut depth = usize::from(self.nodes[0].bounds.entry(origin, &inverse, limit).is_some());
        while depth > 0 {
            depth -= 1;
            let (index, entry) = pending[depth];
            if entry > limit {
                continue;
            }
            let node = &self.nodes[index as usize];
            let first = node.first as usize;
            if node.count > 0 {
                for triangle in &self.triangles[first..first + node.count as usize] {
                    if let Some(range) = triangle.range(origin, direction).filter(|&r| r <= limit)
                        && nearest.is_none_or(|(r, t)| (range, triangle.index) < (r, t.index))
                    {
                        nearest = Some((range, triangle));
                        limit = range;
                    }
                }
                continue;
            }
            let child = |i: usize| Some((i as u32, self.nodes[i].bounds.entry(origin, &inverse, limit)?));
            let (mut near, mut far) = (child(first), child(first + 1));
            if matches!((near, far), (Some(a), Some(b)) if b.1 < a.1) {
                std::mem::swap(&mut near, &mut far);
            }
            for next in [far, near].into_iter().flatten() {
                pending[depth] = next;
                depth += 1;
            }
        }
        let (range, triangle) = nearest?;
        let normal = triangle.edges[0].cross(&triangle.edges[1]).normalize();
        let normal = if normal.dot(direction) > 0.0 { -normal } else { normal };
        Some(Hit { range, normal, triangle: triangle.index as usize })
    }

    /// The whole mesh's bounding box.
    pub(super) fn bounds(&self) -> Aabb {
        self.nodes[0].bounds
    }
}

/// Sorts `triangles` into leaves and returns the tree over them, root first.
fn build(triangles: &mut [Triangle]) -> Vec<Node> {
    let leaf = |run: &[Triangle], first: usize| Node {
        bounds: Aabb::around(run.iter().flat_map(Triangle::corners)),
        first: first as u32,
        count: run.len() as u32,
    };
    let mut nodes = vec![leaf(triangles, 0)];
    let mut pending = vec![(0, 0)];
    while let Some((index, depth)) = pending.pop() {
        let Node { first, count, .. } = nodes[index];
        let run = &mut triangles[first as usize..(first + count) as usize];
        if run.len() <= LEAF_SIZE {
            continue;
        }
        let half = split(run, depth);
        let children = [leaf(&run[..half], first as usize), leaf(&run[half..], first as usize + half)];
        let at = nodes.len();
        nodes.extend(children);
        (nodes[index].first, nodes[index].count) = (at as u32, 0);
        pending.extend([(at, depth + 1), (at + 1, depth + 1)]);
    }
    nodes
}

/// Reorders `run` into two parts, neither empty, and returns the length of the first.
fn split(run: &mut [Triangle], depth: usize) -> usize {
    let Aabb { low, high } = Aabb::around(run.iter().map(Triangle::centroid));
    let axis = (high - low).imax();
    let half = run.len() / 2;
    if high[axis] <= low[axis] || depth >= BALANCED_DEPTH {
        run.select_nth_unstable_by(half, |a, b| a.centroid()[axis].total_cmp(&b.centroid()[axis]));
        return half;
    }
    let scale = BINS as f64 / (high[axis] - low[axis]);
    let bin = |t: &Triangle| (((t.centroid()[axis] - low[axis]) * scale) as usize).min(BINS - 1);

    let mut bins = [(Aabb::EMPTY, 0_usize); BINS];
    for triangle in run.iter() {
        let (bounds, count) = &mut bins[bin(triangle)];
        *bounds = bounds.union(&Aabb::around(triangle.corners()));
        *count += 1;
    }
    let cost = |part: &[(Aabb, usize)]| {
        let bounds = part.iter().fold(Aabb::EMPTY, |b, (other, _)| b.union(other));
        bounds.half_area() * part.iter().map(|&(_, count)| count).sum::<usize>() as f64
    };
    let total_cost = |cut: usize| cost(&bins[..cut]) + cost(&bins[cut..]);
    // The outermost bins hold the extreme centroids, so no cut leaves a side empty.
    let costs: [f64; BINS - 1] = std::array::from_fn(|i| total_cost(i + 1));
    let cut = (1..BINS).min_by(|&a, &b| costs[a - 1].total_cmp(&costs[b - 1])).unwrap_or(BINS / 2);

    let mut end = 0;
    for i in 0..run.len() {
        if bin(&run[i]) < cut {
            run.swap(i, end);
            end += 1;
        }
    }
    end
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn point(extent: f64) -> impl Strategy<Value = [f64; 3]> {
        prop::array::uniform3(-extent..extent)
    }

    proptest! {
        #[test]
        fn agrees_with_brute_force(
            corners in prop::collection::vec((point(1.0), point(0.3), point(0.3)), 1..200),
            rays in prop::collection::vec((point(2.0), point(1.0)), 20),
        ) {
            let mut mesh = TriangleMesh::default();
            for (a, b, c) in corners {
                let n = mesh.vertices.len() as u32;
                let offset = |e: [f64; 3]| [a[0] + e[0], a[1] + e[1], a[2] + e[2]];
                mesh.vertices.extend([a, offset(b), offset(c)]);
                mesh.triangles.push([n, n + 1, n + 2]);
            }
            let bvh = Bvh::new(&mesh).unwrap();
            for (origin, toward) in rays {
                let origin = Vector3::from(origin);
                let direction = (Vector3::from(toward) * 0.5 - origin).normalize();
                let brute = bvh.triangles.iter()
                    .filter_map(|t| Some((t.range(&origin, &direction)?, t.index as usize)))
                    .filter(|&(range, _)| range <= 2.5)
                    .min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
                let hit = bvh.cast(&origin, &direction, 2.5);
                prop_assert_eq!(hit.map(|h| (h.range, h.triangle)), brute);
                if let Some(hit) = hit {
                    prop_assert!(hit.normal.dot(&direction) <= 0.0);
                }
            }
        }
    }

    #[test]
    fn coinciding_triangles_are_split_too() {
        let mesh = TriangleMesh {
            vertices: vec![[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]],
            triangles: vec![[0, 1, 2]; 1000],
        };
        let hit = Bvh::new(&mesh).unwrap().cast(&Vector3::new(0.2, 0.2, 0.0), &Vector3::z(), 10.0).unwrap();
        assert_eq!((hit.range, hit.triangle), (1.0, 0));
        assert_eq!(hit.normal, -Vector3::z());
    }

    #[test]
    fn no_ray_slips_through_a_closed_mesh() {
        let corner = |i: u32| [f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2)];
        let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let mesh = TriangleMesh {
            vertices: (0..8).map(corner).collect(),
            triangles: faces.iter().flat_map(|f| [[f[0], f[1], f[2]], [f[0], f[2], f[3]]]).collect(),
        };
        let bvh = Bvh::new(&mesh).unwrap();
        let center = Vector3::repeat(0.5);
        for i in -20..=20 {
            for j in -20..=20 {
                // Through edges, corners and both diagonals of the face, among others.
                let direction = Vector3::new(f64::from(i), f64::from(j), 20.0).normalize();
                assert!(bvh.cast(&center, &direction, 2.0).is_some(), "{i} {j}");
            }
        }
    }

    #[test]
    fn bad_meshes_are_refused() {
        let vertices = vec![[0.0; 3]; 3];
        let missing = TriangleMesh { vertices: vertices.clone(), triangles: vec![[0, 1, 3]] };
        let not_finite = TriangleMesh { vertices: vec![[f64::NAN; 3]; 3], triangles: vec![[0, 1, 2]] };
        for mesh in [TriangleMesh { vertices, triangles: vec![] }, missing, not_finite] {
            assert!(Bvh::new(&mesh).is_err());
        }
    }
}
