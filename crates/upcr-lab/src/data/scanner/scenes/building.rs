//! One storey of many rooms.

use std::f64::consts::{FRAC_PI_2, PI};

use nalgebra::Vector3;
use rand::Rng;
use rand::seq::SliceRandom;
use upcr::TriangleMesh;

use super::assembly::{Assembly, standing};
use super::room::{chair, dining_table, knick_knack, plant, shelf, sofa};
use crate::random;

type V = Vector3<f64>;

const HEIGHT_M: f64 = 2.8;
const WALL_M: f64 = 0.2;
/// Lengths of a room along x and along y, between the middles of its walls.
const ROOM_M: [[f64; 2]; 2] = [[4.2, 7.5], [4.0, 6.5]];
const DOOR_HEIGHT_M: f64 = 2.05;
/// Share of the walls between rooms that have a door though one could go round.
const SHORT_CUTS: f64 = 0.35;
/// Room left in front of doors.
const CLEARANCE_M: f64 = 0.45;

/// A building, and a way through it.
#[derive(Debug, Clone, PartialEq)]
pub struct Building {
    /// Floor, ceiling, walls and what stands between them.
    pub mesh: TriangleMesh,
    /// Corners of a closed walk over the floor that enters every room by its doors.
    pub tour: Vec<V>,
}

/// A hole in a wall, where it is along the wall.
#[derive(Debug, Clone, Copy)]
struct Opening {
    from: f64,
    to: f64,
    bottom: f64,
    top: f64,
}

/// Where the walls stand.
struct Plan {
    /// x of the walls along y, and y of those along x.
    lines: [Vec<f64>; 2],
    /// Of the wall on line `i` of axis `a`, between the other axis' lines `j` and `j` + 1: `openings[a][i][j]`.
    openings: [Vec<Vec<Option<Opening>>>; 2],
}

/// One storey of at least `rooms` furnished rooms, joined by doors; the floor is at z = 0.
pub fn building(seed: u64, rooms: usize) -> Building {
    let mut rng = random::stream(seed, 0);
    let columns = (rooms.max(1) as f64).sqrt().ceil() as usize;
    let rows = rooms.max(1).div_ceil(columns);
    let mut plan = Plan::new([columns, rows], &mut rng);
    let tour = plan.doors(&mut rng);
    plan.windows(&mut rng);

    let mut building = Assembly::default();
    let [width, depth] = [0, 1].map(|a| plan.lines[a].last().copied().unwrap_or_default());
    let level =
        |z: f64| [V::new(0.0, 0.0, z), V::new(width, 0.0, z), V::new(width, depth, z), V::new(0.0, depth, z)];
    building.quad(level(0.0));
    let [a, b, c, d] = level(HEIGHT_M);
    building.quad([a, d, c, b]);
    plan.walls(&mut building);
    for column in 0..columns {
        for row in 0..rows {
            plan.furnish(&mut building, [column, row], &mut rng);
        }
    }
    Building { mesh: building.mesh, tour }
}

impl Plan {
    fn new(cells: [usize; 2], rng: &mut impl Rng) -> Self {
        let lines = [0, 1].map(|a| {
            let [least, most] = ROOM_M[a];
            let mut at = 0.0;
            std::iter::once(0.0)
                .chain((0..cells[a]).map(|_| {
                    at += rng.random_range(least..most);
                    at
                }))
                .collect::<Vec<f64>>()
        });
        let openings = [0, 1].map(|a| vec![vec![None; cells[1 - a]]; cells[a] + 1]);
        Self { lines, openings }
    }

    fn cells(&self) -> [usize; 2] {
        [0, 1].map(|a| self.lines[a].len() - 1)
    }

    /// The wall between a cell and the next one along an axis, and its ends along itself.
    fn wall(&self, a: usize, cell: [usize; 2]) -> ([usize; 2], [f64; 2]) {
        let other = 1 - a;
        let ends = [self.lines[other][cell[other]], self.lines[other][cell[other] + 1]];
        ([cell[a] + 1, cell[other]], ends)
    }

    /// Makes doors, so that every room can be entered, and the walk that does.
    fn doors(&mut self, rng: &mut impl Rng) -> Vec<V> {
        let [columns, rows] = self.cells();
        let mut seen = vec![vec![false; rows]; columns];
        let mut tour = Vec::new();
        let mut way = vec![[0_usize; 2]];
        seen[0][0] = true;
        tour.push(self.somewhere_in([0, 0], rng));
        // Into depth, and back where it goes no further.
        while let Some(&cell) = way.last() {
            let mut steps: Vec<[usize; 2]> = Vec::new();
            for a in 0..2 {
                for forward in [true, false] {
                    let mut next = cell;
                    next[a] = if forward { cell[a] + 1 } else { cell[a].wrapping_sub(1) };
                    if next[0] < columns && next[1] < rows && !seen[next[0]][next[1]] {
                        steps.push(next);
                    }
                }
            }
            steps.shuffle(rng);
            let next = if let Some(&next) = steps.first() {
                seen[next[0]][next[1]] = true;
                way.push(next);
                next
            } else {
                way.pop();
                let Some(&before) = way.last() else { break };
                before
            };
            let a = usize::from(cell[0] == next[0]);
            let door = self.door(a, if next[a] > cell[a] { cell } else { next }, rng);
            tour.push(door);
            tour.push(self.somewhere_in(next, rng));
        }
        if tour.len() == 1 {
            tour.push(self.somewhere_in([0, 0], rng));
        }
        for a in 0..2 {
            for column in 0..columns {
                for row in 0..rows {
                    let cell = [column, row];
                    if cell[a] + 1 < [columns, rows][a] && rng.random_bool(SHORT_CUTS) {
                        self.door(a, cell, rng);
                    }
                }
            }
        }
        tour
    }

    /// The middle of the door between a cell and the next one along an axis; it is made where there is none.
    fn door(&mut self, a: usize, cell: [usize; 2], rng: &mut impl Rng) -> V {
        let ([i, j], [start, end]) = self.wall(a, cell);
        let at = self.lines[a][i];
        let opening = self.openings[a][i][j].get_or_insert_with(|| {
            let width = if rng.random_bool(0.2) { 1.7 } else { rng.random_range(0.85..1.05) };
            let from = rng.random_range(start + 0.6..end - 0.6 - width);
            Opening { from, to: from + width, bottom: 0.0, top: DOOR_HEIGHT_M }
        });
        let along = f64::midpoint(opening.from, opening.to);
        if a == 0 { V::new(at, along, 0.0) } else { V::new(along, at, 0.0) }
    }

    fn windows(&mut self, rng: &mut impl Rng) {
        let cells = self.cells();
        for a in 0..2 {
            for i in [0, cells[a]] {
                for j in 0..cells[1 - a] {
                    let [start, end] = [self.lines[1 - a][j], self.lines[1 - a][j + 1]];
                    let width = rng.random_range(0.8..2.2);
                    let from = rng.random_range(start + 0.5..end - 0.5 - width);
                    let bottom = rng.random_range(0.7..1.0);
                    self.openings[a][i][j] = Some(Opening { from, to: from + width, bottom, top: 2.2 });
                }
            }
        }
    }

    /// Somewhere about the middle of a room, which furniture leaves free.
    fn somewhere_in(&self, cell: [usize; 2], rng: &mut impl Rng) -> V {
        let [x, y] = [0, 1].map(|a| {
            f64::midpoint(self.lines[a][cell[a]], self.lines[a][cell[a] + 1]) + rng.random_range(-0.7..0.7)
        });
        V::new(x, y, 0.0)
    }

    fn walls(&self, building: &mut Assembly) {
        for a in 0..2 {
            for (i, &at) in self.lines[a].iter().enumerate() {
                for (j, opening) in self.openings[a][i].iter().enumerate() {
                    let [start, end] = [self.lines[1 - a][j], self.lines[1 - a][j + 1]];
                    // A stretch of wall standing at `bottom`.
                    let mut block = |from: f64, to: f64, bottom: f64, top: f64| {
                        if to - from > 1e-9 && top - bottom > 1e-9 {
                            let along = f64::midpoint(from, to);
                            let (base, size) = if a == 0 {
                                (V::new(at, along, bottom), V::new(WALL_M, to - from, top - bottom))
                            } else {
                                (V::new(along, at, bottom), V::new(to - from, WALL_M, top - bottom))
                            };
                            building.cuboid(base, size, 0.0);
                        }
                    };
                    match *opening {
                        None => block(start, end, 0.0, HEIGHT_M),
                        Some(Opening { from, to, bottom, top }) => {
                            block(start, from, 0.0, HEIGHT_M);
                            block(to, end, 0.0, HEIGHT_M);
                            block(from, to, top, HEIGHT_M);
                            block(from, to, 0.0, bottom);
                        }
                    }
                }
            }
        }
    }

    /// Things along the four walls where no door is, and perhaps a table in the middle.
    fn furnish(&self, building: &mut Assembly, cell: [usize; 2], rng: &mut impl Rng) {
        for a in 0..2 {
            for far in [false, true] {
                let i = cell[a] + usize::from(far);
                let inside = self.lines[a][i] + if far { -WALL_M / 2.0 } else { WALL_M / 2.0 };
                let j = cell[1 - a];
                let [start, end] = [self.lines[1 - a][j] + 0.7, self.lines[1 - a][j + 1] - 0.7];
                // The opening is shared with the room behind: what stands before it must leave it free on both sides.
                let door = self.openings[a][i][j].filter(|o| o.bottom == 0.0);
                // Things face into the room, their backs at the wall: they are built looking toward +y.
                let yaw = match (a, far) {
                    (0, false) => -FRAC_PI_2,
                    (0, true) => FRAC_PI_2,
                    (_, false) => 0.0,
                    (_, true) => PI,
                };
                let mut at = start + rng.random_range(0.0..0.8);
                while at < end {
                    let (thing, [width, depth]) = furniture(rng);
                    if at + width > end {
                        break;
                    }
                    let blocks =
                        door.is_some_and(|o| at < o.to + CLEARANCE_M && at + width > o.from - CLEARANCE_M);
                    if !blocks {
                        let along = at + width / 2.0;
                        let off = inside + if far { -depth / 2.0 - 0.01 } else { depth / 2.0 + 0.01 };
                        let place = if a == 0 { V::new(off, along, 0.0) } else { V::new(along, off, 0.0) };
                        building.append(&thing, &standing(place, yaw));
                    }
                    at += width + rng.random_range(0.1..1.2);
                }
            }
        }
        let middle = self.somewhere_in(cell, rng);
        if rng.random_bool(0.6) {
            let table = standing(middle, rng.random_range(-PI..PI));
            building.append(&dining_table(rng), &table);
            for (x, y, yaw) in
                [(-0.35, -0.65, PI), (0.4, 0.65, 0.0), (0.95, -0.05, -FRAC_PI_2), (-1.0, 0.1, FRAC_PI_2)]
            {
                if rng.random_bool(0.6) {
                    let turn = yaw + rng.random_range(-0.5..0.5);
                    building.append(&chair(), &(table * standing(V::new(x, y, 0.0), turn)));
                }
            }
        }
        let lamp = middle + V::new(rng.random_range(-0.9..0.9), rng.random_range(-0.9..0.9), HEIGHT_M);
        let drop = rng.random_range(0.2..0.6);
        building.cylinder(lamp - V::z() * drop, 0.01, drop);
        building.blob(lamp - V::z() * (drop + 0.1), V::new(0.25, 0.25, 0.1), None, 16);
    }
}

/// Something that stands along a wall, its back toward -y, with its width and depth.
fn furniture(rng: &mut impl Rng) -> (Assembly, [f64; 2]) {
    let mut thing = Assembly::default();
    let footprint = match rng.random_range(0..8) {
        0 | 1 => return (shelf(rng), [1.1, 0.32]),
        2 => return (sofa(rng), [1.9, 0.85]),
        // A cupboard.
        3 => {
            let size =
                V::new(rng.random_range(0.6..1.6), rng.random_range(0.35..0.6), rng.random_range(1.2..2.3));
            thing.cuboid(V::zeros(), size, 0.0);
            [size.x, size.y]
        }
        // A sideboard, and what stands on it.
        4 => {
            let size = V::new(rng.random_range(0.9..1.8), 0.42, rng.random_range(0.6..0.95));
            thing.cuboid(V::zeros(), size, 0.0);
            for _ in 0..rng.random_range(1..4) {
                let x = rng.random_range(-0.4..0.4) * size.x;
                knick_knack(&mut thing, V::new(x, 0.0, size.z), rng);
            }
            [size.x, size.y]
        }
        // A desk with a screen and a chair.
        5 => {
            let [width, depth] = [rng.random_range(1.2..1.8), 0.75];
            thing.cuboid(V::new(0.0, 0.0, 0.72), V::new(width, depth, 0.03), 0.0);
            for side in [-1.0, 1.0] {
                thing.cuboid(V::new(side * (width / 2.0 - 0.03), 0.0, 0.0), V::new(0.04, depth, 0.72), 0.0);
            }
            let x = rng.random_range(-0.3..0.3);
            thing.cuboid(V::new(x, -0.15, 0.85), V::new(0.55, 0.04, 0.35), rng.random_range(-0.3..0.3));
            thing.append(&chair(), &standing(V::new(x, 0.55, 0.0), rng.random_range(-0.5..0.5)));
            [width, depth]
        }
        // A picture over a bench.
        6 => {
            let width = rng.random_range(0.5..1.2);
            let height = rng.random_range(0.4..0.8);
            thing.cuboid(V::new(0.0, 0.0, 0.4), V::new(width, 0.36, 0.05), 0.0);
            thing.cuboid(
                V::new(0.0, -0.16, rng.random_range(1.2..1.5)),
                V::new(width * 0.8, 0.04, height),
                0.0,
            );
            [width, 0.36]
        }
        _ => {
            plant(&mut thing, V::zeros(), rng);
            [0.6, 0.6]
        }
    };
    (thing, footprint)
}
