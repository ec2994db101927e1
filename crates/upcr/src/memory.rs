//! How many points a registration has memory for.

use crate::{Error, Result};

/// Bytes that a registration needs whatever the clouds' sizes: features, matches, the network and its passes.
const FIXED: u64 = 12 << 20;
/// Bytes an occupied cell of the finest grid: the grid while it grows, or it and the level that is made of it.
const PER_CELL: u64 = 336;
/// Fewer points of a cloud are not worth registering.
const FEWEST_POINTS: usize = 2000;

/// How many occupied cells the finest grids of clouds of so many points may have, for `bound` bytes to suffice.
///
/// # Errors
/// [`Error::TooLittleMemory`] where a cloud would be left with too few points.
pub(crate) fn most_cells(bound: Option<u64>, points: [usize; 2]) -> Result<[usize; 2]> {
    let Some(bound) = bound else { return Ok(points) };
    let fewest: usize = points.iter().map(|&n| n.min(FEWEST_POINTS)).sum();
    let needed = FIXED + PER_CELL * fewest as u64;
    if bound < needed {
        return Err(Error::TooLittleMemory { given: bound, needed });
    }
    let cells = usize::try_from((bound - FIXED) / PER_CELL).unwrap_or(usize::MAX);
    // Half for each, and what the one can spare for the other.
    let [a, b] = points;
    let second = b.min(cells - a.min(cells / 2));
    Ok([a.min(cells - second), second])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clouds_share_what_there_is() {
        let cells = |n: usize| Some(FIXED + PER_CELL * n as u64);
        assert_eq!(most_cells(None, [7, 5]).unwrap(), [7, 5]);
        assert_eq!(most_cells(cells(10_000), [6000, 3000]).unwrap(), [6000, 3000]);
        assert_eq!(most_cells(cells(10_000), [80_000, 3000]).unwrap(), [7000, 3000]);
        assert_eq!(most_cells(cells(10_000), [3000, 80_000]).unwrap(), [3000, 7000]);
        assert_eq!(most_cells(cells(10_001), [80_000, 80_000]).unwrap(), [5000, 5001]);
        assert_eq!(most_cells(cells(2003), [3, 80_000]).unwrap(), [3, 2000]);
        assert_eq!(most_cells(Some(u64::MAX), [9, 9]).unwrap(), [9, 9]);
    }

    #[test]
    fn the_least_bound_is_told_and_suffices() {
        for points in [[3, 3], [90_000, 500], [90_000, 90_000]] {
            let Err(Error::TooLittleMemory { given: 1, needed }) = most_cells(Some(1), points) else {
                panic!("{points:?}");
            };
            assert!(most_cells(Some(needed - 1), points).is_err());
            let most = most_cells(Some(needed), points).unwrap();
            assert!(most.iter().zip(points).all(|(&m, n)| m >= n.min(FEWEST_POINTS)), "{most:?}");
        }
    }
}
