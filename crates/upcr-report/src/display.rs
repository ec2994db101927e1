//! A cloud as a page holds it: few enough points, in random order, in few bytes.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::Serialize;
use upcr::neighbors::KdTree;
use upcr::{CloudRole, Error, PointCloud, Result, Rigid};

/// Clouds with more points are thinned to so many.
pub const MOST_POINTS: usize = 1_000_000;

/// Red, green and blue of clouds that have no colours of their own, on light pages; after the last comes the first again.
pub const CLOUD_COLORS: [[u8; 3]; 6] = [
    [0xcf, 0x5f, 0x0c],
    [0x11, 0x67, 0x8f],
    [0x5f, 0x8a, 0x1d],
    [0x7d, 0x55, 0xb5],
    [0xb8, 0x44, 0x7e],
    [0x6b, 0x63, 0x57],
];

/// Steps along the longest edge of a cloud's box: as fine as single precision is, which draws it.
const STEPS: f64 = ((1 << 24) - 1) as f64;
/// Queries of one task.
const BLOCK: usize = 1 << 12;
/// Distances are told up to this share of the target's diagonal.
const REACH: f64 = 0.05;

/// How a cloud is drawn: what its points in the page are told in.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Drawn {
    /// In the file, and in the page.
    pub points: usize,
    pub shown: usize,
    /// Without finite coordinates.
    pub left_out: usize,
    pub origin: [f64; 3],
    pub step: f64,
    pub colors: bool,
}

/// The part of a cloud that is displayed.
pub(crate) struct Displayed<'a> {
    cloud: &'a PointCloud,
    /// Indices into the cloud, in random order: the first so many are a sample of all.
    pub chosen: Vec<u32>,
    /// Points without finite coordinates.
    pub left_out: usize,
    pub origin: [f64; 3],
    pub step: f64,
}

impl<'a> Displayed<'a> {
    pub fn new(cloud: &'a PointCloud, most: usize) -> Result<Self> {
        let finite = |p: &[f64; 3]| p.iter().all(|v| v.is_finite());
        let mut chosen: Vec<u32> =
            (0..cloud.len() as u32).filter(|&i| finite(&cloud.points[i as usize])).collect();
        if chosen.is_empty() {
            return Err(Error::TooFewPoints { role: CloudRole::Cloud, found: 0, needed: 1 });
        }
        let left_out = cloud.len() - chosen.len();
        shuffle(&mut chosen, most);
        let (mut min, mut max) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for &i in &chosen {
            for (k, v) in cloud.points[i as usize].into_iter().enumerate() {
                min[k] = min[k].min(v);
                max[k] = max[k].max(v);
            }
        }
        // Halves do not overflow where the edges of a senseless cloud do.
        let edge = (0..3).map(|k| 0.5 * max[k] - 0.5 * min[k]).fold(0.0, f64::max);
        Ok(Self { cloud, chosen, left_out, origin: min, step: 2.0 * (edge / STEPS) })
    }

    fn points(&self) -> impl Iterator<Item = [f64; 3]> + '_ {
        self.chosen.iter().map(|&i| self.cloud.points[i as usize])
    }

    /// Coordinates in steps from the origin, three bytes each, the lowest first.
    pub fn packed(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(9 * self.chosen.len());
        for p in self.points() {
            for k in 0..3 {
                let steps = if self.step > 0.0 { ((p[k] - self.origin[k]) / self.step).round() } else { 0.0 };
                bytes.extend_from_slice(&(steps.min(STEPS) as u32).to_le_bytes()[..3]);
            }
        }
        bytes
    }

    /// Puts points and colours among the blobs, under the cloud's number.
    pub fn draw(&self, number: usize, blobs: &mut Vec<(String, Vec<u8>)>) -> Drawn {
        blobs.push((format!("points-{number}"), self.packed()));
        let colors = self.colors();
        let drawn = Drawn {
            points: self.cloud.len(),
            shown: self.chosen.len(),
            left_out: self.left_out,
            origin: self.origin,
            step: self.step,
            colors: colors.is_some(),
        };
        blobs.extend(colors.map(|colors| (format!("colors-{number}"), colors)));
        drawn
    }

    /// These points alone, moved.
    pub fn moved(&self, pose: &Rigid) -> PointCloud {
        let colors = self.cloud.colors.as_ref();
        PointCloud {
            colors: colors.map(|colors| self.chosen.iter().map(|&i| colors[i as usize]).collect()),
            ..PointCloud::from_points(self.points().map(|p| pose.apply(p)).collect())
        }
    }

    /// Red, green, blue, where the cloud has them.
    pub fn colors(&self) -> Option<Vec<u8>> {
        let colors = self.cloud.colors.as_ref()?;
        Some(self.chosen.iter().flat_map(|&i| colors[i as usize]).collect())
    }
}

/// Puts `most` of the values, drawn at random, in random order to the front and drops the rest.
fn shuffle(values: &mut Vec<u32>, most: usize) {
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let (len, most) = (values.len(), most.min(values.len()));
    for i in 0..most {
        values.swap(i, rng.random_range(i as u64..len as u64) as usize);
    }
    values.truncate(most);
    values.shrink_to_fit();
}

/// All of a cloud, to find the distance of other points to it.
pub(crate) struct Surface {
    tree: KdTree,
    origin: [f64; 3],
    /// Farther points are not told apart.
    pub reach: f64,
}

impl Surface {
    /// `None` where the cloud has no extent, and distances no scale.
    pub fn new(cloud: &PointCloud, displayed: &Displayed) -> Option<Self> {
        let origin = displayed.origin;
        let local = |p: [f64; 3]| std::array::from_fn(|k| (p[k] - origin[k]) as f32);
        let points: Vec<[f32; 3]> =
            cloud.points.iter().filter(|p| p.iter().all(|v| v.is_finite())).map(|&p| local(p)).collect();
        let mut most = [0.0_f64; 3];
        for p in displayed.points() {
            for k in 0..3 {
                most[k] = most[k].max(p[k] - origin[k]);
            }
        }
        let reach = REACH * most[0].hypot(most[1]).hypot(most[2]);
        let measurable = |v: f64| (v * v) as f32 > 0.0 && (v * v) < f64::from(f32::MAX);
        // Wherever squares of single precision hold the whole cloud and a thousandth of what is to be told.
        (measurable(1e-3 * reach) && measurable(reach / REACH)).then(|| Self {
            tree: KdTree::new(&points),
            origin,
            reach,
        })
    }

    /// Distances of the displayed points, moved by `pose`, in 65535ths of the reach.
    pub fn distances(&self, moved: &Displayed, pose: &Rigid) -> Vec<u16> {
        let reach_sq = (self.reach * self.reach) as f32;
        let distance = |&i: &u32| {
            let p = pose.apply(moved.cloud.points[i as usize]);
            let query: [f32; 3] = std::array::from_fn(|k| (p[k] - self.origin[k]) as f32);
            let near = query.iter().all(|v| v.is_finite()).then(|| self.tree.nearest(query, reach_sq));
            near.flatten().map_or(u16::MAX, |n| {
                (f64::from(n.distance_sq).sqrt() / self.reach * f64::from(u16::MAX)).round() as u16
            })
        };
        moved.chosen.par_iter().with_min_len(BLOCK).map(distance).collect()
    }
}

/// The distance from which on colours are the last one: three voxels, or where none is known, as much as is usual.
pub(crate) fn range(voxel_size: Option<f64>, distances: &[u16], reach: f64) -> f64 {
    let usual = || {
        let mut within: Vec<u16> = distances.iter().copied().filter(|&d| d < u16::MAX).collect();
        let middle = within.len() / 2;
        if within.is_empty() {
            reach
        } else {
            reach * f64::from(*within.select_nth_unstable(middle).1) / f64::from(u16::MAX)
        }
    };
    let wished = voxel_size.filter(|&v| v > 0.0).unwrap_or_else(usual) * 3.0;
    wished.clamp(1e-3 * reach, reach)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(n: usize, at: f64) -> PointCloud {
        PointCloud::from_points((0..n).map(|i| [at + i as f64, 2.0 * at, at]).collect())
    }

    fn unpack(shown: &Displayed) -> Vec<[f64; 3]> {
        let number = |b: &[u8]| f64::from(u32::from_le_bytes([b[0], b[1], b[2], 0]));
        shown
            .packed()
            .chunks(9)
            .map(|p| std::array::from_fn(|k| shown.origin[k] + shown.step * number(&p[3 * k..3 * k + 3])))
            .collect()
    }

    #[test]
    fn colors_are_those_of_the_style_sheet() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../web/report/style.css");
        let sheet = std::fs::read_to_string(path).unwrap();
        for (i, [r, g, b]) in CLOUD_COLORS.into_iter().enumerate() {
            let declared = sheet.split_once(&format!("--cloud-{i}: ")).unwrap().1;
            assert!(declared.starts_with(&format!("#{r:02x}{g:02x}{b:02x};")), "{i}");
        }
        assert!(!sheet.contains(&format!("--cloud-{}: ", CLOUD_COLORS.len())));
    }

    #[test]
    fn points_come_back_wherever_they_are() {
        let cloud = line(1000, 5_400_000.25);
        let shown = Displayed::new(&cloud, MOST_POINTS).unwrap();
        for (&i, back) in shown.chosen.iter().zip(unpack(&shown)) {
            let p = cloud.points[i as usize];
            assert!((0..3).all(|k| (p[k] - back[k]).abs() < 1e-4), "{p:?} {back:?}");
        }
    }

    #[test]
    fn thinning_is_spread_over_the_file_and_the_same_each_time() {
        let cloud = line(10_000, 0.0);
        let shown = Displayed::new(&cloud, 1000).unwrap();
        assert_eq!(shown.chosen, Displayed::new(&cloud, 1000).unwrap().chosen);
        let mut sorted = shown.chosen.clone();
        sorted.sort_unstable();
        sorted.dedup();
        assert_eq!(sorted.len(), 1000);
        for tenth in 0..10 {
            let range = 1000 * tenth..1000 * (tenth + 1);
            let all = shown.chosen.iter().filter(|i| range.contains(*i)).count();
            let first = shown.chosen[..200].iter().filter(|i| range.contains(*i)).count();
            assert!((60..140).contains(&all) && (5..40).contains(&first), "{tenth}: {all}, {first}");
        }
    }

    #[test]
    fn points_that_are_nowhere_are_left_out_and_told() {
        let mut cloud = line(10, 0.0);
        cloud.points[3][1] = f64::NAN;
        let shown = Displayed::new(&cloud, MOST_POINTS).unwrap();
        assert_eq!((shown.chosen.len(), shown.left_out), (9, 1));
        cloud.points.truncate(0);
        assert!(Displayed::new(&cloud, MOST_POINTS).is_err());
    }

    #[test]
    fn distances_are_to_all_of_the_target() {
        let target = line(5000, 1e6);
        let (a, b) = (line(5000, 1e6), Displayed::new(&target, 100).unwrap());
        let surface = Surface::new(&target, &b).unwrap();
        let shown = Displayed::new(&a, MOST_POINTS).unwrap();
        let up = Rigid::from_translation([0.0, 0.0, 0.1 * surface.reach]);
        let tenth = f64::from(u16::MAX) / 10.0;
        assert!(surface.distances(&shown, &Rigid::identity()).iter().all(|&d| d == 0));
        assert!(surface.distances(&shown, &up).iter().all(|&d| (f64::from(d) - tenth).abs() <= 2.0));
        let away = Rigid::from_translation([0.0, 0.0, 2.0 * surface.reach]);
        assert!(surface.distances(&shown, &away).iter().all(|&d| d == u16::MAX));
    }

    #[test]
    fn senseless_clouds_are_displayed_without_distances() {
        for points in [vec![[1.0; 3]; 5], vec![[-1e308; 3], [1e308; 3]], vec![[0.0; 3], [1e-300; 3]]] {
            let cloud = PointCloud::from_points(points);
            let shown = Displayed::new(&cloud, MOST_POINTS).unwrap();
            assert!(shown.step.is_finite());
            assert_eq!(shown.packed().len(), 9 * cloud.len());
            assert!(Surface::new(&cloud, &shown).is_none());
        }
    }
}
