//! The neighbour graphs of a batch of clouds, and the way back along their edges.

use std::ops::Range;

use upcr::net::Graph;

/// The graphs of several clouds, whose points are rows one after the other. Edges stay inside a cloud.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct BatchGraph {
    /// Neighbours a point.
    pub k: usize,
    /// Cloud `c` has the rows `offsets[c]..offsets[c + 1]`.
    pub offsets: Vec<usize>,
    /// For every row its `k` neighbours, counted from its cloud's first row.
    pub neighbors: Vec<u32>,
    /// Row `j` is the neighbour of the points `sources[source_offsets[j]..source_offsets[j + 1]]` of its cloud.
    source_offsets: Vec<u32>,
    sources: Vec<u32>,
}

impl BatchGraph {
    /// Joins the graphs of single clouds. In a cloud with fewer than `k` points, its last neighbour stands for the
    /// missing ones, which changes no maximum.
    pub fn new<'a>(graphs: impl IntoIterator<Item = &'a Graph>, k: usize) -> Self {
        let mut joined = Self { k, offsets: vec![0], ..Self::default() };
        for graph in graphs {
            if graph.k == k {
                joined.neighbors.extend_from_slice(&graph.neighbors);
            } else {
                for row in 0..graph.len() {
                    let row = graph.row(row);
                    let padding = row.last().copied();
                    joined.neighbors.extend(row.iter().copied().chain(padding.into_iter().cycle()).take(k));
                }
            }
            joined.offsets.push(joined.neighbors.len() / k);
        }
        joined.transpose();
        joined
    }

    /// Lists for every row the points that have it as a neighbour.
    fn transpose(&mut self) {
        self.source_offsets = vec![0; self.rows() + 1];
        self.sources = vec![0; self.neighbors.len()];
        for cloud in 0..self.clouds() {
            let rows = self.cloud(cloud);
            let edges = rows.start * self.k..rows.end * self.k;
            for &j in &self.neighbors[edges.clone()] {
                self.source_offsets[rows.start + j as usize + 1] += 1;
            }
            for row in rows.clone() {
                self.source_offsets[row + 1] += self.source_offsets[row];
            }
            let mut next = self.source_offsets[rows.clone()].to_vec();
            for (edge, &j) in self.neighbors[edges].iter().enumerate() {
                self.sources[next[j as usize] as usize] = (edge / self.k) as u32;
                next[j as usize] += 1;
            }
        }
    }

    /// Number of points of all clouds.
    pub fn rows(&self) -> usize {
        self.offsets.last().copied().unwrap_or(0)
    }

    /// Number of clouds.
    pub fn clouds(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// Number of edges of all clouds.
    pub fn edges(&self) -> usize {
        self.neighbors.len()
    }

    /// Rows of a cloud.
    pub fn cloud(&self, cloud: usize) -> Range<usize> {
        self.offsets[cloud]..self.offsets[cloud + 1]
    }

    /// One cloud's part of the graph.
    pub fn view(&self, cloud: usize) -> CloudGraph<'_> {
        let rows = self.cloud(cloud);
        CloudGraph {
            k: self.k,
            neighbors: &self.neighbors[rows.start * self.k..rows.end * self.k],
            source_offsets: &self.source_offsets[rows.start..=rows.end],
            sources: &self.sources,
        }
    }

    /// Splits a slice with `width` values a row into the clouds' parts.
    pub fn split_mut<'a, T>(&self, mut values: &'a mut [T], width: usize) -> Vec<&'a mut [T]> {
        let mut parts = Vec::with_capacity(self.clouds());
        for cloud in 0..self.clouds() {
            let (part, rest) = values.split_at_mut(self.cloud(cloud).len() * width);
            parts.push(part);
            values = rest;
        }
        parts
    }
}

/// One cloud's part of a [`BatchGraph`], its rows counted from 0.
#[derive(Debug, Clone, Copy)]
pub struct CloudGraph<'a> {
    /// Neighbours a point.
    pub k: usize,
    /// Row after row of `k` indices.
    pub neighbors: &'a [u32],
    source_offsets: &'a [u32],
    sources: &'a [u32],
}

impl CloudGraph<'_> {
    /// Number of points.
    pub fn rows(&self) -> usize {
        self.source_offsets.len() - 1
    }

    /// Neighbours of a point.
    #[inline(always)]
    pub fn row(&self, i: usize) -> &[u32] {
        &self.neighbors[i * self.k..(i + 1) * self.k]
    }

    /// The points that have `j` as a neighbour.
    #[inline(always)]
    pub fn sources(&self, j: usize) -> &[u32] {
        &self.sources[self.source_offsets[j] as usize..self.source_offsets[j + 1] as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clouds_are_joined_and_the_way_back_is_found() {
        let a = Graph { k: 2, neighbors: vec![0, 1, 1, 0, 2, 1] };
        let b = Graph { k: 1, neighbors: vec![0] };
        let graph = BatchGraph::new([&a, &b], 2);
        assert_eq!((graph.clouds(), graph.rows(), graph.edges()), (2, 4, 8));
        assert_eq!(graph.neighbors, [0, 1, 1, 0, 2, 1, 0, 0]);
        let view = graph.view(0);
        assert_eq!([view.sources(0), view.sources(1), view.sources(2)], [&[0, 1][..], &[0, 1, 2], &[2]]);
        assert_eq!(graph.view(1).sources(0), [0, 0]);
        let mut values = [0; 8];
        assert_eq!(graph.split_mut(&mut values, 2).iter().map(|p| p.len()).collect::<Vec<_>>(), [6, 2]);
    }
}
