//! A furnished room.

use std::f64::consts::{FRAC_PI_2, PI};

use nalgebra::Vector3;
use rand::Rng;
use upcr::{Rigid, TriangleMesh};

use super::assembly::{Assembly, Bumps, standing};
use crate::random;

type V = Vector3<f64>;

/// Length, width and height between the walls.
pub const ROOM_SIZE_M: [f64; 3] = [5.0, 4.0, 2.7];
/// How far the window and the door lie behind their walls.
const RECESS_M: f64 = 0.15;

/// A living room of 5 × 4 × 2.7 m about the vertical through the origin, the floor at z = 0, furniture along its walls.
pub fn room(seed: u64) -> TriangleMesh {
    let mut rng = random::stream(seed, 0);
    let [length, width, height] = ROOM_SIZE_M;
    let mut room = walls(&mut rng);

    // Along the wall at -y: the shelf and a sideboard with things on it.
    let shelf_x = rng.random_range(-1.7..-1.4);
    room.append(&shelf(&mut rng), &standing(V::new(shelf_x, -width / 2.0 + 0.17, 0.0), 0.0));
    let sideboard_x = rng.random_range(0.6..1.2);
    let sideboard = V::new(1.3, 0.42, rng.random_range(0.7..0.9));
    room.cuboid(V::new(sideboard_x, -width / 2.0 + 0.22, 0.0), sideboard, 0.0);
    for i in 0..3 {
        let at = V::new(sideboard_x + 0.45 * (f64::from(i) - 1.0), -width / 2.0 + 0.22, sideboard.z);
        knick_knack(&mut room, at, &mut rng);
    }
    // At +x: the sofa with the floor lamp in the corner; at -x: a wardrobe and a plant.
    let sofa_y = rng.random_range(-0.3..0.2);
    room.append(&sofa(&mut rng), &standing(V::new(length / 2.0 - 0.5, sofa_y, 0.0), FRAC_PI_2));
    lamp(&mut room, V::new(length / 2.0 - 0.4, width / 2.0 - 0.45, 0.0));
    let wardrobe = V::new(0.58, rng.random_range(1.0..1.4), rng.random_range(1.8..2.1));
    room.cuboid(V::new(-length / 2.0 + 0.29, 1.2, 0.0), wardrobe, 0.0);
    plant(&mut room, V::new(-length / 2.0 + 0.4, -0.2, 0.0), &mut rng);
    // In the middle: a table with chairs, and a lamp hanging over it.
    let table_yaw = rng.random_range(-0.4..0.4);
    let table = standing(V::new(rng.random_range(-0.3..0.3), 0.2, 0.0), table_yaw);
    room.append(&dining_table(&mut rng), &table);
    for (x, y, yaw) in [(-0.35, -0.6, PI), (0.4, 0.65, 0.0), (0.95, -0.05, -FRAC_PI_2)] {
        let turn = yaw + rng.random_range(-0.35..0.35);
        room.append(&chair(), &(table * standing(V::new(x, y, 0.0), turn)));
    }
    room.cylinder(V::new(0.0, 0.2, height - 0.5), 0.01, 0.5);
    room.blob(V::new(0.0, 0.2, height - 0.6), V::repeat(0.17), None, 32);
    room.mesh
}

/// A wall panel of `size` with a hole through which one sees a recessed pane, in the plane y = 0, seen from +y.
///
/// `hole` is left, right, bottom and top of the opening, x leftmost at -`size[0]` / 2.
pub(super) fn panel_with_recess(panel: &mut Assembly, size: [f64; 2], hole: [f64; 4], depth: f64) {
    let [left, right, bottom, top] = hole;
    let [x0, x1, height] = [-size[0] / 2.0, size[0] / 2.0, size[1]];
    let at = |x: f64, z: f64| V::new(x, 0.0, z);
    let back = |x: f64, z: f64| V::new(x, -depth, z);
    let strips = [
        [(x0, 0.0), (x0, height), (left, height), (left, 0.0)],
        [(right, 0.0), (right, height), (x1, height), (x1, 0.0)],
        [(left, top), (left, height), (right, height), (right, top)],
        [(left, 0.0), (left, bottom), (right, bottom), (right, 0.0)],
    ];
    for strip in strips {
        panel.quad(strip.map(|(x, z)| at(x, z)));
    }
    let corners = [(left, bottom), (left, top), (right, top), (right, bottom)];
    for i in 0..4 {
        let ((x, z), (next_x, next_z)) = (corners[i], corners[(i + 1) % 4]);
        panel.quad([at(x, z), back(x, z), back(next_x, next_z), at(next_x, next_z)]);
    }
    panel.quad(corners.map(|(x, z)| back(x, z)));
}

/// Floor, ceiling and four walls, with a window, a door and pictures.
fn walls(rng: &mut impl Rng) -> Assembly {
    let [length, width, height] = ROOM_SIZE_M;
    let (x, y) = (length / 2.0, width / 2.0);
    let mut walls = Assembly::default();
    let level = |z: f64| [V::new(-x, -y, z), V::new(x, -y, z), V::new(x, y, z), V::new(-x, y, z)];
    walls.quad(level(0.0));
    let [a, b, c, d] = level(height);
    walls.quad([a, d, c, b]);

    let window_left = rng.random_range(-1.2..-0.4);
    let mut window = Assembly::default();
    let hole = [window_left, window_left + 1.4, 0.9, 2.2];
    panel_with_recess(&mut window, [width, height], hole, RECESS_M);
    window.cuboid(V::new(window_left + 0.7, -0.1, 0.9), V::new(0.06, 0.06, 1.3), 0.0);
    walls.append(&window, &standing(V::new(x, 0.0, 0.0), FRAC_PI_2));
    let mut door = Assembly::default();
    let door_left = rng.random_range(0.7..0.9);
    panel_with_recess(&mut door, [width, height], [door_left, door_left + 0.9, 0.0, 2.05], RECESS_M / 2.0);
    door.blob(V::new(door_left + 0.8, -0.03, 1.0), V::repeat(0.035), None, 16);
    walls.append(&door, &standing(V::new(-x, 0.0, 0.0), -FRAC_PI_2));
    for (side, yaw) in [(-1.0, 0.0), (1.0, PI)] {
        let mut wall = Assembly::default();
        let corner = |u: f64, z: f64| V::new(u * x, 0.0, z);
        wall.quad([corner(-1.0, 0.0), corner(-1.0, height), corner(1.0, height), corner(1.0, 0.0)]);
        for place in [-0.5, 0.45] {
            let size = V::new(rng.random_range(0.4..0.9), 0.06, rng.random_range(0.35..0.7));
            wall.cuboid(V::new(place * x, 0.03, rng.random_range(1.4..1.6)), size, 0.0);
        }
        walls.append(&wall, &standing(V::new(0.0, side * y, 0.0), yaw));
    }
    // A radiator of ribs under a picture.
    for rib in 0..9 {
        walls.cuboid(V::new(-0.2 + 0.08 * f64::from(rib), y - 0.06, 0.12), V::new(0.05, 0.1, 0.6), 0.0);
    }
    walls
}

pub(super) fn shelf(rng: &mut impl Rng) -> Assembly {
    let (width, depth, height, boards) = (1.1, 0.32, 1.9, 5);
    let mut shelf = Assembly::default();
    for side in [-0.5, 0.5] {
        shelf.cuboid(V::new(side * width, 0.0, 0.0), V::new(0.03, depth, height), 0.0);
    }
    let pitch = height / f64::from(boards);
    for board in 0..=boards {
        let z = (f64::from(board) * pitch).min(height - 0.03);
        shelf.cuboid(V::new(0.0, 0.0, z), V::new(width, depth, 0.03), 0.0);
        if board == boards {
            break;
        }
        let mut x = -width / 2.0 + 0.03;
        loop {
            let thickness = rng.random_range(0.02..0.09);
            if x + thickness > width / 2.0 - 0.03 {
                break;
            }
            let size =
                V::new(thickness, rng.random_range(0.5..0.9) * depth, rng.random_range(0.4..0.85) * pitch);
            if rng.random_bool(0.75) {
                shelf.cuboid(V::new(x + thickness / 2.0, 0.0, z + 0.03), size, 0.0);
            }
            x += thickness;
        }
    }
    shelf
}

pub(super) fn sofa(rng: &mut impl Rng) -> Assembly {
    // Its back stands at -y, so that it faces +y before it is turned.
    let mut sofa = Assembly::default();
    sofa.cuboid(V::new(0.0, 0.0, 0.08), V::new(1.9, 0.85, 0.34), 0.0);
    sofa.cuboid(V::new(0.0, -0.33, 0.08), V::new(1.9, 0.2, 0.75), 0.0);
    for side in [-0.87, 0.87] {
        sofa.cuboid(V::new(side, 0.0, 0.08), V::new(0.18, 0.85, 0.52), 0.0);
    }
    for place in [-0.5, 0.1, 0.55] {
        let cushion = Bumps::new(rng, 2, 1.5, 0.05, 0.5);
        let at = V::new(place + rng.random_range(-0.1..0.1), -0.12, 0.58);
        sofa.blob(at, V::new(0.22, 0.1, 0.2), Some(&cushion), 32);
    }
    sofa
}

pub(super) fn dining_table(rng: &mut impl Rng) -> Assembly {
    let mut table = Assembly::default();
    table.cuboid(V::new(0.0, 0.0, 0.71), V::new(1.4, 0.85, 0.04), 0.0);
    for (x, y) in [(-0.62, -0.35), (0.62, -0.35), (-0.62, 0.35), (0.62, 0.35)] {
        table.cylinder(V::new(x, y, 0.0), 0.03, 0.71);
    }
    for (x, y) in [(-0.45, 0.1), (-0.1, -0.2), (0.2, 0.15), (0.5, -0.1)] {
        knick_knack(&mut table, V::new(x, y, 0.75), rng);
    }
    table
}

pub(super) fn chair() -> Assembly {
    // Its backrest stands at +y.
    let mut chair = Assembly::default();
    chair.cuboid(V::new(0.0, 0.0, 0.43), V::new(0.42, 0.42, 0.04), 0.0);
    chair.cuboid(V::new(0.0, 0.2, 0.47), V::new(0.42, 0.03, 0.45), 0.0);
    for (x, y) in [(-0.18, -0.18), (0.18, -0.18), (-0.18, 0.18), (0.18, 0.18)] {
        chair.cuboid(V::new(x, y, 0.0), V::new(0.035, 0.035, 0.43), 0.0);
    }
    chair
}

/// A vase, a box or a stone.
pub(super) fn knick_knack(scene: &mut Assembly, base: V, rng: &mut impl Rng) {
    let size = rng.random_range(0.07..0.13);
    match rng.random_range(0..3) {
        0 => {
            let profile =
                [(0.0, 0.0), (0.6, 0.0), (1.0, 0.7), (0.9, 1.3), (0.4, 1.9), (0.55, 2.3), (0.0, 2.2)];
            scene.revolve(base, &profile.map(|(r, z)| (r * size, z * size)), 32);
        }
        1 => {
            let size = V::new(2.0, rng.random_range(1.0..1.6), rng.random_range(0.8..2.0)) * size;
            scene.cuboid(base, size, rng.random_range(0.0..PI));
        }
        _ => {
            let bumps = Bumps::new(rng, 3, 1.5, 0.08, 0.5);
            scene.blob(base + V::z() * size * 0.9, V::repeat(size), Some(&bumps), 48);
        }
    }
}

fn lamp(scene: &mut Assembly, base: V) {
    scene.cylinder(base, 0.15, 0.03);
    scene.cylinder(base, 0.015, 1.5);
    scene.blob(base + V::z() * 1.62, V::repeat(0.18), None, 32);
}

pub(super) fn plant(scene: &mut Assembly, base: V, rng: &mut impl Rng) {
    scene.revolve(base, &[(0.0, 0.0), (0.14, 0.0), (0.2, 0.35), (0.0, 0.33)], 24);
    for _ in 0..7 {
        let tilt = standing(base + V::z() * 0.33, rng.random_range(-PI..PI));
        let mut leaf = Assembly::default();
        leaf.blob(V::zeros(), V::new(0.05, 0.1, rng.random_range(0.25..0.45)), None, 24);
        let lean =
            nalgebra::Rotation3::from_axis_angle(&V::y_axis(), rng.random_range(0.2..0.6)).into_inner();
        let placed = tilt * Rigid { rotation: lean, translation: lean * V::z() * 0.3 };
        scene.append(&leaf, &placed);
    }
}
