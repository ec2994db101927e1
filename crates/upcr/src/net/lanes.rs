//! How the inner loops of inference lay out what they work on.

/// Channels that are worked on together: their products over a cloud stay in cache until they are gathered.
pub(super) const BLOCK: usize = 32;
/// Points that are multiplied together.
pub(super) const TILE: usize = 6;

/// One value of a block's channels each.
pub(super) type Lanes = [f32; BLOCK];

/// Four values of a row, in bytes.
pub(super) type Quad = [u8; 4];
/// Four weights of each channel, of a block's two products one after the other.
pub(super) type QuadLanes = [[i8; 4]; 2 * BLOCK];
/// Inner products of quads.
pub(super) type Sums = [i32; 2 * BLOCK];
/// Upper bounds of a block's products or values.
pub(super) type Bounds = [i16; BLOCK];

/// A point, and a bit for each channel of a block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Hit {
    pub point: u32,
    pub channels: u32,
}

/// The number of rows that hold `points` in whole tiles.
pub(super) fn whole_tiles(points: usize) -> usize {
    points.next_multiple_of(TILE)
}
