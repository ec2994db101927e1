//! Choosing few of many points.

use multiversion::multiversion;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{CloudRole, PointCloud, Result};

/// Points whose distances are kept up to date together.
const BLOCK: usize = 64;

/// Farthest-point sampling (Eldar et al. 1997): from `start` on, always the point farthest from all chosen
/// before, of equals the first. Returns indices in the order chosen, `count` of them or as many as there are
/// points. Takes time proportional to `points.len() * count`.
pub fn farthest_points(points: &[[f32; 3]], count: usize, start: usize) -> Vec<usize> {
    let count = count.min(points.len());
    let mut chosen = Vec::with_capacity(count);
    if count == 0 {
        return chosen;
    }
    let mut blocks: Vec<Block> = points.chunks(BLOCK).map(Block::new).collect();
    let mut latest = start.min(points.len() - 1);
    while chosen.len() < count {
        chosen.push(latest);
        latest = farthest_after(&mut blocks, points[latest], latest);
    }
    chosen
}

/// `count` different indices below `len` (all where `count` is more), in ascending order, each set of them
/// equally likely.
pub fn random_indices(len: usize, count: usize, seed: u64) -> Vec<usize> {
    let count = count.min(len);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut indices: Vec<usize> = (0..len).collect();
    for i in 0..count {
        indices.swap(i, rng.random_range(i as u64..len as u64) as usize);
    }
    indices.truncate(count);
    indices.sort_unstable();
    indices
}

impl PointCloud {
    /// `count` points by farthest-point sampling from the first on ([`farthest_points`]), in the order chosen.
    ///
    /// # Errors
    /// [`crate::Error::NonFinite`] where a coordinate is not finite.
    pub fn farthest_sample(&self, count: usize) -> Result<Self> {
        let Some(bounds) = self.checked_bounds(CloudRole::Cloud)? else { return Ok(self.clone()) };
        Ok(self.select(&farthest_points(&self.local_points(bounds.center()), count, 0)))
    }

    /// `count` points at random ([`random_indices`]), in the cloud's order.
    #[must_use]
    pub fn random_sample(&self, count: usize, seed: u64) -> Self {
        self.select(&random_indices(self.len(), count, seed))
    }
}

/// Points and their squared distances to the nearest chosen point.
struct Block {
    position: [[f32; BLOCK]; 3],
    /// As bits, which order as the non-negative numbers do and whose maximum vectorises; a point that is
    /// chosen, or no point at all, has none left (0).
    distance_sq: [u32; BLOCK],
}

impl Block {
    fn new(points: &[[f32; 3]]) -> Self {
        let mut block = Self { position: [[0.0; BLOCK]; 3], distance_sq: [0; BLOCK] };
        for (l, p) in points.iter().enumerate() {
            for a in 0..3 {
                block.position[a][l] = p[a];
            }
            // One more than zero distance: a duplicate of a chosen point still goes before a chosen point.
            block.distance_sq[l] = f32::INFINITY.to_bits() + 1;
        }
        block
    }
}

/// Takes point `index` at `latest` for chosen; returns the index of the point now farthest.
#[multiversion(targets("x86_64+avx2"))]
fn farthest_after(blocks: &mut [Block], latest: [f32; 3], index: usize) -> usize {
    blocks[index / BLOCK].distance_sq[index % BLOCK] = 0;
    let (mut farthest, mut farthest_block) = (0, 0);
    for (b, block) in blocks.iter_mut().enumerate() {
        let mut block_farthest = 0;
        for l in 0..BLOCK {
            let [x, y, z] = [0, 1, 2].map(|a| block.position[a][l] - latest[a]);
            let distance_sq = (x * x + y * y + z * z).to_bits() + 1;
            block.distance_sq[l] = block.distance_sq[l].min(distance_sq);
            block_farthest = block_farthest.max(block.distance_sq[l]);
        }
        if block_farthest > farthest {
            (farthest, farthest_block) = (block_farthest, b);
        }
    }
    let lane = blocks[farthest_block].distance_sq.iter().position(|&d| d == farthest).unwrap_or(0);
    farthest_block * BLOCK + lane
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scattered(n: usize) -> Vec<[f32; 3]> {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        (0..n).map(|_| [rng.random(), rng.random(), rng.random()]).collect()
    }

    #[test]
    fn every_point_chosen_is_the_farthest() {
        let points = scattered(300);
        let chosen = farthest_points(&points, 40, 7);
        assert_eq!((chosen.len(), chosen[0]), (40, 7));
        let distance_sq =
            |i: usize, j: usize| (0..3).map(|a| (points[i][a] - points[j][a]).powi(2)).sum::<f32>();
        for m in 1..40 {
            let reach = |i| chosen[..m].iter().map(|&j| distance_sq(i, j)).fold(f32::INFINITY, f32::min);
            assert!((0..300).all(|i| reach(i) <= reach(chosen[m]) * (1.0 + 1e-6)));
        }
    }

    #[test]
    fn duplicates_are_chosen_last_and_no_index_twice() {
        let mut points = vec![[1.0, 0.0, 0.0]; 70];
        points.push([2.0, 0.0, 0.0]);
        let mut chosen = farthest_points(&points, 100, 3);
        assert_eq!(chosen[..3], [3, 70, 0]);
        chosen.sort_unstable();
        assert_eq!(chosen, (0..71).collect::<Vec<_>>());
    }

    #[test]
    fn random_indices_are_distinct_and_follow_the_seed() {
        let some = random_indices(1000, 100, 5);
        assert!(some.is_sorted_by(|a, b| a < b) && some.len() == 100 && some[99] < 1000);
        assert_eq!(some, random_indices(1000, 100, 5));
        assert_ne!(some, random_indices(1000, 100, 6));
        assert_eq!(random_indices(3, 9, 0), [0, 1, 2]);
    }
}
