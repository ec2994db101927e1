//! Where a sensor saw a surface, the way to it is empty: points of another scan that stand in it speak against the pose.

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::{
    neighbors::{KdTree, Neighbor},
    prepare::{Level, Prepared},
    transform::Rigid,
};

const BLOCK: usize = 64;
/// Rays that tell how far the sensor saw past a point: the nearest ones.
const RAYS: usize = 8;
/// A ray is so many voxels wide, where it ends, to either side.
const WIDTH_VOXELS: f32 = 2.0;
/// A point in free space is so many voxels away from every other, and nearer than the surfaces behind it by as much and by
/// this share of their range, with which a sensor's errors grow.
const CLEAR_VOXELS: f32 = 2.0;
const CLEAR: f32 = 0.05;
/// More rays tell nothing new.
const MOST_RAYS: usize = 16_384;

/// What a sensor saw of its surroundings from one place.
pub(crate) struct View {
    eye: Vector3<f32>,
    /// Unit vectors from the eye to the points, and how long the ways are.
    directions: KdTree,
    ranges: Vec<f32>,
    /// Half the width of a ray's end, and the least way before it that counts as free.
    width: f32,
    clear: f32,
}

impl View {
    /// Of `cloud`, where it is known from where it was seen.
    pub fn of(cloud: &Prepared) -> Option<Self> {
        let (eye, level) = (Vector3::from(cloud.viewpoint?), &cloud.fine);
        let rays = level.spread(MOST_RAYS);
        let spacing = level.voxel_size * (level.points.len() as f32 / rays.len().max(1) as f32).sqrt();
        let ways = rays.iter().map(|&i| Vector3::from(level.points[i as usize]) - eye);
        let seen = ways.map(|way| (way, way.norm())).filter(|(_, range)| *range > 0.0);
        let (directions, ranges): (Vec<[f32; 3]>, Vec<f32>) =
            seen.map(|(way, range)| (<[f32; 3]>::from(way / range), range)).unzip();
        Some(Self {
            eye,
            directions: KdTree::new(&directions),
            ranges,
            width: WIDTH_VOXELS * spacing,
            clear: CLEAR_VOXELS * level.voxel_size,
        })
    }

    /// Whether the sensor saw past `point` to something behind.
    fn sees_past(&self, point: Vector3<f32>, found: &mut Vec<Neighbor>) -> bool {
        let way = point - self.eye;
        let range = way.norm();
        if range == 0.0 {
            return false;
        }
        self.directions.knn((way / range).into(), RAYS, found);
        let passing = found.iter().filter_map(|ray| {
            let end = self.ranges[ray.index as usize];
            (ray.distance_sq.sqrt() * end <= self.width).then_some(end)
        });
        let nearest = passing.fold(f32::INFINITY, f32::min);
        nearest.is_finite() && range + self.clear.max(CLEAR * nearest) < nearest
    }
}

/// A cloud's points that are asked where they stand, and what its sensor saw.
#[derive(Clone, Copy)]
pub(crate) struct Seen<'a> {
    pub level: &'a Level,
    pub points: &'a [u32],
    pub view: Option<&'a View>,
}

/// Of the points that lie beside the other cloud or where its sensor saw past them, the share of the latter at `pose`;
/// `None` where neither sensor's place is known.
pub(crate) fn in_free_space(source: Seen, target: Seen, pose: &Rigid) -> Option<f64> {
    let there = standing(source, target, pose);
    let back = standing(target, source, &pose.inverse());
    let [free, beside] = match (there, back) {
        (Some(there), Some(back)) => [there[0] + back[0], there[1] + back[1]],
        (one, other) => one.or(other)?,
    };
    Some(free as f64 / (free + beside).max(1) as f64)
}

/// How many of the points of `from`, moved by `pose`, the sensor of `to` saw past, and how many lie beside what it saw.
fn standing(from: Seen, to: Seen, pose: &Rigid) -> Option<[usize; 2]> {
    let view = to.view?;
    let rotation = pose.rotation.map(|v| v as f32);
    let translation = pose.translation.map(|v| v as f32);
    let one = |found: &mut Vec<Neighbor>, &i: &u32| {
        let y = rotation * Vector3::from(from.level.points[i as usize]) + translation;
        if to.level.tree.nearest(y.into(), view.clear * view.clear).is_some() {
            [0, 1]
        } else {
            [usize::from(view.sees_past(y, found)), 0]
        }
    };
    let places: Vec<[usize; 2]> =
        from.points.par_iter().with_min_len(BLOCK).map_init(Vec::new, one).collect();
    Some(places.iter().fold([0, 0], |sum, place| [sum[0] + place[0], sum[1] + place[1]]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        CloudRole, PointCloud,
        prepare::{Described, check, prepare},
        watch::{Call, Watch},
    };

    const SPACING: f64 = 0.1;
    /// Where the sensor stands.
    const EYE: [f64; 3] = [0.3, -0.2, 1.0];

    fn prepared(points: Vec<[f64; 3]>, viewpoint: Option<[f64; 3]>) -> Prepared {
        let cloud = PointCloud { viewpoint, ..PointCloud::from_points(points) };
        let call = Call::new(None, Watch::default());
        let checked = check(&cloud, CloudRole::Source, &call).unwrap();
        prepare(&checked, SPACING, Described::Never, cloud.len(), &call).unwrap()
    }

    /// A square wall across z about (0, 0, `z`), a little uneven.
    fn wall(z: f64, half: f64) -> Vec<[f64; 3]> {
        let steps = (half / SPACING) as i32;
        let at = |i: i32| f64::from(i) * SPACING;
        (-steps..=steps)
            .flat_map(|i| (-steps..=steps).map(move |j| [at(i), at(j), z + 0.01 * f64::from((i * j) % 3)]))
            .collect()
    }

    /// Share of `source`, where it is, that stands where the sensor of the wall at z = 6 saw through.
    fn share_before_the_wall(source: Vec<[f64; 3]>) -> Option<f64> {
        let (source, target) = (prepared(source, None), prepared(wall(6.0, 2.0), Some(EYE)));
        let view = View::of(&target);
        let [all, none] = [source.fine.spread(usize::MAX), Vec::new()];
        let pose = Rigid::from_translation(target.origin).inverse() * Rigid::from_translation(source.origin);
        in_free_space(
            Seen { level: &source.fine, points: &all, view: None },
            Seen { level: &target.fine, points: &none, view: view.as_ref() },
            &pose,
        )
    }

    #[test]
    fn what_stands_before_the_wall_is_in_free_space() {
        assert_eq!(share_before_the_wall(wall(4.0, 0.5)), Some(1.0));
    }

    #[test]
    fn what_is_hidden_or_out_of_sight_or_on_the_wall_is_not() {
        let beside = wall(4.0, 0.5).into_iter().map(|[x, y, z]| [x + 4.0, y, z]).collect();
        let behind_the_sensor = wall(-4.0, 0.5);
        for elsewhere in [wall(8.0, 0.5), beside, behind_the_sensor, wall(6.0, 0.5), wall(5.8, 0.5)] {
            assert_eq!(share_before_the_wall(elsewhere), Some(0.0));
        }
    }

    #[test]
    fn the_share_is_of_what_can_be_judged() {
        let mut source = wall(4.0, 0.5);
        let before = source.len();
        source.extend(wall(6.0, 1.0));
        let judged = source.len();
        source.extend(wall(9.0, 1.0));
        let found = share_before_the_wall(source).unwrap();
        assert!((found - before as f64 / judged as f64).abs() < 0.02, "{found}");
    }

    #[test]
    fn both_sensors_are_asked_and_without_any_nothing_is_known() {
        let share = |near_eye: Option<[f64; 3]>, far_eye: Option<[f64; 3]>| {
            let (near, far) = (prepared(wall(4.0, 0.5), near_eye), prepared(wall(6.0, 2.0), far_eye));
            let views = [View::of(&near), View::of(&far)];
            let points = [near.fine.spread(usize::MAX), far.fine.spread(usize::MAX)];
            let pose = Rigid::from_translation(far.origin).inverse() * Rigid::from_translation(near.origin);
            in_free_space(
                Seen { level: &near.fine, points: &points[0], view: views[0].as_ref() },
                Seen { level: &far.fine, points: &points[1], view: views[1].as_ref() },
                &pose,
            )
        };
        assert_eq!(share(None, None), None);
        assert_eq!(share(None, Some(EYE)), Some(1.0));
        // The nearer wall's sensor saw nothing past it, and nothing beside it.
        assert_eq!(share(Some(EYE), None), Some(0.0));
        assert_eq!(share(Some(EYE), Some(EYE)), Some(1.0));
    }
}
