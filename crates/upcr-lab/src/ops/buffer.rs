//! Memory that is used again: fresh pages cost more than the arithmetic on them.

use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, PoisonError};

/// Buffers that wait to be used again, at most.
const WAITING: usize = 256;

/// A slice whose memory is used again when it is dropped. Its first values are whatever they are.
#[derive(Debug, Default)]
pub(super) struct Buffer<T: Pooled> {
    values: Vec<T>,
}

/// A type with a pool of its own.
pub(super) trait Pooled: Copy + Default + 'static {
    fn pool() -> &'static Mutex<Vec<Vec<Self>>>;
}

impl Pooled for f32 {
    fn pool() -> &'static Mutex<Vec<Vec<Self>>> {
        static POOL: Mutex<Vec<Vec<f32>>> = Mutex::new(Vec::new());
        &POOL
    }
}

impl Pooled for u8 {
    fn pool() -> &'static Mutex<Vec<Vec<Self>>> {
        static POOL: Mutex<Vec<Vec<u8>>> = Mutex::new(Vec::new());
        &POOL
    }
}

impl<T: Pooled> Buffer<T> {
    /// A buffer of `length` values: the smallest that waits and is large enough but not wasteful, or a new one.
    pub fn new(length: usize) -> Self {
        let mut pool = T::pool().lock().unwrap_or_else(PoisonError::into_inner);
        let fits = |values: &Vec<T>| values.len() >= length && values.len() <= 2 * length;
        let best = (0..pool.len()).filter(|&i| fits(&pool[i])).min_by_key(|&i| pool[i].len());
        let waiting = best.map(|i| pool.remove(i));
        drop(pool);
        let mut values = waiting.unwrap_or_else(|| vec![T::default(); length]);
        values.truncate(length);
        Self { values }
    }
}

impl<T: Pooled> Drop for Buffer<T> {
    fn drop(&mut self) {
        let mut pool = T::pool().lock().unwrap_or_else(PoisonError::into_inner);
        if self.values.is_empty() {
            return;
        }
        // The one that waits longest has least use.
        if pool.len() == WAITING {
            pool.remove(0);
        }
        pool.push(std::mem::take(&mut self.values));
    }
}

impl<T: Pooled> Deref for Buffer<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        &self.values
    }
}

impl<T: Pooled> DerefMut for Buffer<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.values
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_used_again() {
        // A size that no other test asks for.
        let mut first = Buffer::<f32>::new(98_765);
        first[7] = 3.0;
        let address = first.as_ptr();
        drop(first);
        let second = Buffer::<f32>::new(98_765);
        assert_eq!((second.as_ptr(), second.len(), second[7]), (address, 98_765, 3.0));
        assert_ne!(Buffer::<f32>::new(98_765).as_ptr(), address);
    }
}
