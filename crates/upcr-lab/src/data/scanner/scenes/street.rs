//! A street between houses.

use std::f64::consts::{FRAC_PI_2, PI};

use nalgebra::Vector3;
use rand::Rng;
use upcr::{Rigid, TriangleMesh};

use super::assembly::{Assembly, Bumps, standing};
use super::room::panel_with_recess;
use crate::random;

type V = Vector3<f64>;

/// Length of the street, along x about the origin.
pub const STREET_LENGTH_M: f64 = 100.0;
/// Distance of a lane's middle from that of the street.
pub const LANE_M: f64 = 1.8;
/// Half the width of the carriageway.
const KERB_M: f64 = 5.5;
/// Distance of the house fronts from the middle of the street, before their setbacks.
const FRONT_M: f64 = 9.0;

/// A street of 100 m along x with houses, trees, lamp posts and parked cars; the ground is at about z = 0.
pub fn street(seed: u64) -> TriangleMesh {
    let mut rng = random::stream(seed, 0);
    let mut street = Assembly::default();
    let relief = Bumps::new(&mut rng, 4, 40.0, 0.08, 0.4);
    let half_width = FRONT_M + 12.0;
    street.surface([250, 100], |u, v| {
        let at = V::new((u - 0.5) * STREET_LENGTH_M, (v - 0.5) * 2.0 * half_width, 0.0);
        let pavement = if at.y.abs() > KERB_M { 0.12 } else { 0.0 };
        at + V::z() * (relief.at(&at) + pavement)
    });
    // Each side is built along +x at +y; the other one is turned by half a turn.
    for yaw in [0.0, PI] {
        let mut side = houses(&mut rng);
        furniture(&mut side, &mut rng);
        street.append(&side, &standing(V::zeros(), yaw));
    }
    street.mesh
}

fn houses(rng: &mut impl Rng) -> Assembly {
    let mut row = Assembly::default();
    let mut x = -STREET_LENGTH_M / 2.0;
    while x < STREET_LENGTH_M / 2.0 {
        if rng.random_bool(0.12) {
            x += rng.random_range(3.0..7.0);
            continue;
        }
        let windows = rng.random_range(3..=6);
        let pitch = rng.random_range(2.2..3.0);
        let width = pitch * f64::from(windows);
        if x + width > STREET_LENGTH_M / 2.0 {
            break;
        }
        let setback = rng.random_range(0.0..2.0);
        // The front looks toward -y, the carriageway.
        let pose = standing(V::new(x + width / 2.0, FRONT_M + setback, 0.0), PI);
        row.append(&house(windows, pitch, rng), &pose);
        x += width;
    }
    row
}

/// A house of the given number of windows on a floor, its front in the plane y = 0, looking toward +y.
fn house(windows: i32, pitch: f64, rng: &mut impl Rng) -> Assembly {
    let floors = rng.random_range(2..=4);
    let storey = rng.random_range(2.9..3.5);
    let (width, height, depth) = (pitch * f64::from(windows), storey * f64::from(floors), 9.0);
    let door = rng.random_range(0..windows);
    let half = rng.random_range(0.45..0.7);
    let recess = rng.random_range(0.15..0.35);
    let mut house = Assembly::default();
    for floor in 0..floors {
        for window in 0..windows {
            let mut cell = Assembly::default();
            let hole = match (floor, window == door) {
                (0, true) => [-0.6, 0.6, 0.0, 2.3],
                _ => [-half, half, 0.9, 2.4],
            };
            panel_with_recess(&mut cell, [pitch, storey], hole, recess);
            if floor > 0 && rng.random_bool(0.15) {
                cell.cuboid(V::new(0.0, 0.5, 0.1), V::new(pitch * 0.8, 1.0, 0.9), 0.0);
            }
            let x = pitch * (f64::from(window) + 0.5) - width / 2.0;
            house.append(&cell, &Rigid::from_translation([x, 0.0, storey * f64::from(floor)]));
        }
    }
    let at = |x: f64, y: f64, z: f64| V::new(x * width / 2.0, -y * depth, z);
    for x in [-1.0, 1.0] {
        house.quad([at(x, 0.0, 0.0), at(x, 1.0, 0.0), at(x, 1.0, height), at(x, 0.0, height)]);
    }
    let ridge = height + rng.random_range(1.0..3.5);
    for (eaves, x) in [(0.0, 1.0), (1.0, -1.0)] {
        let slope = [at(x, eaves, height), at(-x, eaves, height), at(-x, 0.5, ridge), at(x, 0.5, ridge)];
        house.quad(slope);
    }
    for x in [-1.0, 1.0] {
        // A gable is a quadrilateral with two corners in one.
        house.quad([at(x, 0.0, height), at(x, 1.0, height), at(x, 0.5, ridge), at(x, 0.5, ridge)]);
    }
    let chimney = V::new(width * rng.random_range(-0.3..0.3), -depth * 0.35, height);
    house.cuboid(chimney, V::new(0.6, 0.6, ridge - height + 0.8), 0.0);
    house
}

/// Trees, lamp posts, bins and parked cars along the pavement at +y.
fn furniture(side: &mut Assembly, rng: &mut impl Rng) {
    let half_length = STREET_LENGTH_M / 2.0 - 3.0;
    let mut x = -half_length;
    while x < half_length {
        let at = V::new(x, KERB_M + rng.random_range(0.6..1.2), 0.0);
        match rng.random_range(0..5) {
            0 | 1 => tree(side, at, rng),
            2 => {
                let height = rng.random_range(4.5..6.0);
                side.cylinder(at, 0.08, height);
                side.cuboid(at + V::new(0.0, -0.6, height), V::new(0.3, 1.4, 0.15), 0.0);
            }
            3 => side.cylinder(at, 0.3, 1.0),
            _ => side.cuboid(at, V::new(0.7, 0.5, rng.random_range(0.9..1.6)), rng.random_range(0.0..PI)),
        }
        x += rng.random_range(3.0..8.0);
    }
    let mut x = -half_length;
    while x < half_length {
        if rng.random_bool(0.55) {
            let yaw = rng.random_range(-0.06..0.06) + FRAC_PI_2 * 2.0 * f64::from(rng.random_range(0..2));
            side.append(&car(rng), &standing(V::new(x, KERB_M - 1.1, 0.0), yaw));
        }
        x += rng.random_range(5.3..7.0);
    }
}

fn tree(scene: &mut Assembly, base: V, rng: &mut impl Rng) {
    let trunk = rng.random_range(1.8..2.8);
    scene.revolve(base, &[(0.0, 0.0), (0.22, 0.0), (0.15, trunk), (0.12, trunk + 1.0)], 16);
    let crown = V::new(rng.random_range(1.2..1.8), rng.random_range(1.2..1.8), rng.random_range(1.4..2.2));
    let leaves = Bumps::new(rng, 5, 1.2, 0.1, 0.7);
    scene.blob(base + V::z() * (trunk + crown.z * 0.8), crown, Some(&leaves), 64);
}

fn car(rng: &mut impl Rng) -> Assembly {
    let mut car = Assembly::default();
    let (length, height) = (rng.random_range(3.8..4.9), rng.random_range(1.4..1.9));
    car.cuboid(V::new(0.0, 0.0, 0.3), V::new(length, 1.75, 0.55), 0.0);
    // The cabin: a box narrowing upward.
    let level = |z: f64, front: f64, back: f64, half: f64| {
        [V::new(back, -half, z), V::new(front, -half, z), V::new(front, half, z), V::new(back, half, z)]
    };
    let low = level(0.85, length * 0.22, -length * 0.42, 0.82);
    let high = level(height, length * 0.06, -length * 0.32, 0.65);
    for i in 0..4 {
        let next = (i + 1) % 4;
        car.quad([low[i], low[next], high[next], high[i]]);
    }
    car.quad(high);
    let wheel_turn = nalgebra::Rotation3::from_axis_angle(&V::x_axis(), FRAC_PI_2).into_inner();
    let mut wheel = Assembly::default();
    wheel.cylinder(V::new(0.0, 0.0, -0.1), 0.32, 0.2);
    for (x, y) in [(-0.32, -0.8), (0.32, -0.8), (-0.32, 0.8), (0.32, 0.8)] {
        car.append(&wheel, &Rigid { rotation: wheel_turn, translation: V::new(x * length, y, 0.32) });
    }
    car
}
