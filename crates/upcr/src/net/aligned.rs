//! Memory that starts on a cache line.

use std::marker::PhantomData;
use std::ops::{Deref, DerefMut};

/// Numbers of which every pattern of bits is one, and arrays of them.
///
/// # Safety
/// Types that implement it hold no padding, are aligned to at most a [`Line`], and are valid whatever their bytes.
pub(super) unsafe trait Plain: Copy {}

// SAFETY: numbers.
unsafe impl Plain for i8 {}
// SAFETY: numbers.
unsafe impl Plain for i16 {}
// SAFETY: numbers.
unsafe impl Plain for i32 {}
// SAFETY: numbers.
unsafe impl Plain for f32 {}
// SAFETY: an array is its elements.
unsafe impl<T: Plain, const N: usize> Plain for [T; N] {}

/// A cache line, as long as the longest vector.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
struct Line([u8; 64]);

/// A vector whose first value starts on a cache line. A load that crosses lines costs two, and in a vector that starts
/// anywhere every load of a whole line crosses.
#[derive(Debug, Clone)]
pub(super) struct Aligned<T> {
    lines: Vec<Line>,
    len: usize,
    of: PhantomData<T>,
}

impl<T> Default for Aligned<T> {
    fn default() -> Self {
        Self { lines: Vec::new(), len: 0, of: PhantomData }
    }
}

impl<T: Plain> Aligned<T> {
    /// As [`Vec::resize`].
    pub fn resize(&mut self, len: usize, value: T) {
        self.lines.resize((len * size_of::<T>()).div_ceil(size_of::<Line>()), Line([0; 64]));
        let before = std::mem::replace(&mut self.len, len);
        if let Some(new) = self.get_mut(before..) {
            new.fill(value);
        }
    }
}

impl<T: Plain> From<&[T]> for Aligned<T> {
    fn from(values: &[T]) -> Self {
        let mut aligned = Self::default();
        if let Some(&first) = values.first() {
            aligned.resize(values.len(), first);
            aligned.copy_from_slice(values);
        }
        aligned
    }
}

impl<T: Plain> FromIterator<T> for Aligned<T> {
    fn from_iter<I: IntoIterator<Item = T>>(values: I) -> Self {
        values.into_iter().collect::<Vec<_>>().as_slice().into()
    }
}

impl<T: Plain> Deref for Aligned<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        // SAFETY: `resize` alone changes the length; the lines hold that many values, which are plain.
        unsafe { std::slice::from_raw_parts(self.lines.as_ptr().cast(), self.len) }
    }
}

impl<T: Plain> DerefMut for Aligned<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        // SAFETY: as above.
        unsafe { std::slice::from_raw_parts_mut(self.lines.as_mut_ptr().cast(), self.len) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_kept_and_start_on_a_line() {
        let mut aligned: Aligned<[f32; 3]> = (0..50).map(|i| [i as f32; 3]).collect();
        for (len, kept) in [(50, 50), (20, 20), (200, 20), (0, 0), (7, 0)] {
            aligned.resize(len, [-1.0; 3]);
            assert_eq!(aligned.len(), len);
            assert_eq!(aligned.as_ptr().align_offset(64), 0);
            for (i, value) in aligned.iter().enumerate() {
                assert_eq!(*value, [if i < kept { i as f32 } else { -1.0 }; 3]);
            }
        }
    }
}
