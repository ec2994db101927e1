//! Learning in parts: a batch is seen part by part, each normalising itself, and the parts' gradients are averaged. Who
//! sees which part does not matter, so several machines that share the parts out learn what one does, to the last bit.

use std::ops::Range;

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Tensor, TensorData};
use upcr::{Error, Result};

use crate::models::Learned;
use crate::models::dense::BatchStatistics;

/// Members that learn one network together, as one of them sees them.
pub trait Team {
    /// Which of that many parts are this member's; members have consecutive ranges, none of them empty.
    fn own(&self, parts: usize) -> Range<usize>;

    /// All parts' rows in the parts' order, from those of the own parts. Every member calls this as often as the
    /// others, and waits for them.
    ///
    /// # Errors
    /// Where a member is lost.
    fn gather(&mut self, own: Vec<Vec<f64>>) -> Result<Vec<Vec<f64>>>;
}

/// The one who learns alone: every part is its own.
#[derive(Debug, Clone, Copy, Default)]
pub struct Alone;

impl Team for Alone {
    fn own(&self, parts: usize) -> Range<usize> {
        0..parts
    }

    fn gather(&mut self, own: Vec<Vec<f64>>) -> Result<Vec<Vec<f64>>> {
        Ok(own)
    }
}

/// The sum of the weights that are the rows' first entries, and the weighted mean of the rows' others, over all parts in
/// their order.
///
/// # Errors
/// As [`Team::gather`], or where the members' rows are not of one length.
pub(super) fn mean(team: &mut dyn Team, own: Vec<Vec<f64>>) -> Result<(f64, Vec<f64>)> {
    let parts = team.gather(own)?;
    let whole: f64 = parts.iter().filter_map(|part| part.first()).sum();
    let mut mean = vec![0.0; parts.first().map_or(0, Vec::len).saturating_sub(1)];
    for part in &parts {
        let Some((weight, values)) = part.split_first().filter(|(_, values)| values.len() == mean.len())
        else {
            return Err(misfit());
        };
        let share = weight / whole;
        for (mean, value) in mean.iter_mut().zip(values) {
            *mean += share * value;
        }
    }
    Ok((whole, mean))
}

fn misfit() -> Error {
    Error::InvalidSetting { name: "team", reason: "its members do not learn the same network".into() }
}

/// What a batch, or a part of one, teaches.
pub(super) struct Lesson {
    pub loss: f64,
    pub gradients: GradientsParams,
    pub statistics: BatchStatistics,
}

impl Lesson {
    /// As a row that [`mean`] takes, of that many pairs.
    pub fn to_row(&self, pairs: usize, network: &Learned) -> Vec<f64> {
        let mut row = vec![pairs as f64, self.loss];
        for tensor in self.statistics.iter().flatten() {
            row.extend(tensor.to_data().iter::<f64>());
        }
        let mut writer = Writer { gradients: &self.gradients, row };
        network.visit(&mut writer);
        writer.row
    }

    /// The same in another's values: what [`mean`] makes of rows.
    pub fn filled(mut self, mean: &[f64], network: &Learned) -> Result<Self> {
        let (&loss, mut values) = mean.split_first().ok_or_else(misfit)?;
        self.loss = loss;
        for tensor in self.statistics.iter_mut().flatten() {
            *tensor = read(tensor, &mut values)?;
        }
        let mut reader = Reader { gradients: self.gradients, values, failed: None };
        network.visit(&mut reader);
        match reader.failed {
            None if reader.values.is_empty() => Ok(Self { gradients: reader.gradients, ..self }),
            None => Err(misfit()),
            Some(error) => Err(error),
        }
    }
}

/// A tensor like `old` of the first of the values, which are taken.
fn read<const D: usize>(old: &Tensor<D>, values: &mut &[f64]) -> Result<Tensor<D>> {
    let shape = old.dims();
    let (own, rest) = values.split_at_checked(shape.iter().product()).ok_or_else(misfit)?;
    *values = rest;
    let own: Vec<f32> = own.iter().map(|&value| value as f32).collect();
    Ok(Tensor::from_data(TensorData::new(own, shape), &old.device()))
}

/// Appends gradients in the network's own order; parameters that are not learned have none.
struct Writer<'a> {
    gradients: &'a GradientsParams,
    row: Vec<f64>,
}

impl ModuleVisitor for Writer<'_> {
    fn visit_float<const D: usize>(&mut self, parameter: &Param<Tensor<D>>) {
        if let Some(gradient) = self.gradients.get::<D>(parameter.id) {
            self.row.extend(gradient.into_data().iter::<f64>());
        }
    }
}

/// Replaces gradients in the same order.
struct Reader<'a> {
    gradients: GradientsParams,
    values: &'a [f64],
    failed: Option<Error>,
}

impl ModuleVisitor for Reader<'_> {
    fn visit_float<const D: usize>(&mut self, parameter: &Param<Tensor<D>>) {
        let Some(old) = self.gradients.remove::<D>(parameter.id) else { return };
        match read(&old, &mut self.values) {
            Ok(gradient) => self.gradients.register(parameter.id, gradient),
            Err(error) => drop(self.failed.get_or_insert(error)),
        }
    }
}
