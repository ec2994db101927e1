//! Operations on rows and sequences as the framework sees them: differentiable functions of tensors.

use std::sync::Arc;

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, AutodiffBackend, Backend, Dispatch, Flex, backend_extension};
use burn::tensor::Tensor;
use burn_flex::FlexTensor;

use super::attention::Shape;
use super::extension::{Kept, LayerOutput, normalized, on_cpu, tensor, values};
use super::{Normalized, attention as attention_kernel, generic, pool as pool_kernel, rows};

/// What queries `[batch, points, channels]` find in values `[batch, others, value_channels]` by their likeness to keys
/// `[batch, others, channels]`, head by head: softmax(scale · Q Kᵀ) V.
pub fn attention(
    queries: Tensor<3>,
    keys: Tensor<3>,
    values: Tensor<3>,
    heads: usize,
    scale: f32,
) -> Tensor<3> {
    if !on_cpu(&queries.device()) {
        return generic::attention(queries, keys, values, heads, scale);
    }
    let ([batch, points, channels], [_, others, width]) = (queries.dims(), values.dims());
    let shape = Shape { batch, queries: points, keys: others, channels, values: width, heads, scale };
    let [queries, keys, values] = [queries, keys, values].map(Tensor::into_dispatch);
    Tensor::from_dispatch(Dispatch::attention(queries, keys, values, shape))
}

/// Rows `[rows, inputs]` through a map `[outputs, inputs]`, a shift, and a rectifier with that slope for negative values
/// (1: none).
pub fn dense(x: Tensor<2>, weight: Tensor<2>, bias: Tensor<1>, slope: f32) -> Tensor<2> {
    if !on_cpu(&x.device()) {
        return generic::dense(x, weight, bias, slope);
    }
    let (x, weight, bias) = (x.into_dispatch(), weight.into_dispatch(), bias.into_dispatch());
    Tensor::from_dispatch(Dispatch::dense(x, weight, bias, slope))
}

/// Rows `[rows, channels]` normalised by their own statistics, and a rectifier. The variance is the population's.
pub fn batch_norm(x: Tensor<2>, gamma: Tensor<1>, beta: Tensor<1>, slope: f32) -> Normalized {
    if !on_cpu(&x.device()) {
        return generic::batch_norm(x, gamma, beta, slope);
    }
    let (x, gamma, beta) = (x.into_dispatch(), gamma.into_dispatch(), beta.into_dispatch());
    normalized(Dispatch::batch_norm(x, gamma, beta, slope))
}

/// Each row `[rows, channels]` about its mean, by its (unbiased) standard deviation, scaled and shifted by channel.
pub fn layer_norm(x: Tensor<2>, scale: Tensor<1>, shift: Tensor<1>) -> Tensor<2> {
    if !on_cpu(&x.device()) {
        return generic::layer_norm(x, scale, shift);
    }
    let (x, scale, shift) = (x.into_dispatch(), scale.into_dispatch(), shift.into_dispatch());
    Tensor::from_dispatch(Dispatch::layer_norm(x, scale, shift))
}

/// The largest values `[groups, channels]` of groups of `size` rows, one after the other.
pub fn group_max(x: Tensor<2>, size: usize) -> Tensor<2> {
    if !on_cpu(&x.device()) {
        return generic::group_max(x, size);
    }
    Tensor::from_dispatch(Dispatch::group_max(x.into_dispatch(), size))
}

/// The operations that a backend brings.
#[backend_extension(Flex, Autodiff)]
#[allow(missing_docs)]
pub trait RowOperations: Backend {
    fn attention(
        queries: FloatTensor<Self>,
        keys: FloatTensor<Self>,
        of: FloatTensor<Self>,
        shape: Shape,
    ) -> FloatTensor<Self>;

    fn dense(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        slope: f32,
    ) -> FloatTensor<Self>;

    fn batch_norm(
        x: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
        slope: f32,
    ) -> LayerOutput<Self>;

    fn layer_norm(
        x: FloatTensor<Self>,
        scale: FloatTensor<Self>,
        shift: FloatTensor<Self>,
    ) -> FloatTensor<Self>;

    fn group_max(x: FloatTensor<Self>, size: usize) -> FloatTensor<Self>;
}

/// Gradients of an operation's inputs, from that of its values and which are wanted.
type Back<const N: usize> = dyn Fn(&[f32], [bool; N]) -> [Vec<f32>; N] + Send + Sync;

/// A step of the way back, whatever it is.
#[derive(Debug)]
struct Step;

impl<const N: usize> Backward<Flex, N> for Step {
    type State = Kept<(Arc<Back<N>>, [Vec<usize>; N])>;

    fn backward(self, ops: Ops<Self::State, N>, grads: &mut Gradients, _: &mut Checkpointer) {
        let Kept((back, shapes)) = ops.state;
        let grad_out = grads.consume::<Flex>(&ops.node).to_contiguous();
        let found = back(values(&grad_out), ops.parents.each_ref().map(Option::is_some));
        for ((parent, found), shape) in ops.parents.into_iter().zip(found).zip(shapes) {
            if let Some(parent) = parent {
                grads.register::<Flex>(parent.id, tensor(found, &shape));
            }
        }
    }
}

/// `out` of `inputs`, with its way back.
fn tracked<C: CheckpointStrategy, const N: usize>(
    inputs: [&FloatTensor<Autodiff<Flex, C>>; N],
    out: FlexTensor,
    back: impl Fn(&[f32], [bool; N]) -> [Vec<f32>; N] + Send + Sync + 'static,
) -> FloatTensor<Autodiff<Flex, C>> {
    let shapes = inputs.map(|input| input.primitive().layout().shape().to_vec());
    match Step.prepare::<C>(inputs.map(FloatTensor::<Autodiff<Flex, C>>::node)).compute_bound().stateful() {
        OpsKind::Tracked(node) => node.finish(Kept((Arc::new(back), shapes)), out),
        OpsKind::UnTracked(node) => node.finish(out),
    }
}

/// `values` as rows of so many channels.
fn table(values: Vec<f32>, channels: usize) -> FlexTensor {
    let rows = values.len() / channels.max(1);
    tensor(values, &[rows, channels])
}

fn found(out: Vec<f32>, shape: &Shape) -> FlexTensor {
    tensor(out, &[shape.batch, shape.queries, shape.values])
}

fn layer(out: Vec<f32>, norm: &rows::BatchNorm) -> LayerOutput<Flex> {
    let channels = norm.mean.len();
    LayerOutput {
        values: table(out, channels),
        mean: tensor(norm.mean.clone(), &[channels]),
        variance: tensor(norm.variance.clone(), &[channels]),
    }
}

impl RowOperations for Flex {
    fn attention(queries: FlexTensor, keys: FlexTensor, of: FlexTensor, shape: Shape) -> FlexTensor {
        let inputs = [queries, keys, of].map(|tensor| tensor.to_contiguous());
        found(attention_kernel::forward(inputs.each_ref().map(values), &shape).0, &shape)
    }

    fn dense(x: FlexTensor, weight: FlexTensor, bias: FlexTensor, slope: f32) -> FlexTensor {
        let [x, weight, bias] = [x, weight, bias].map(|tensor| tensor.to_contiguous());
        table(rows::dense(values(&x), values(&weight), values(&bias), slope), values(&bias).len())
    }

    fn batch_norm(x: FlexTensor, gamma: FlexTensor, beta: FlexTensor, slope: f32) -> LayerOutput<Self> {
        let [x, gamma, beta] = [x, gamma, beta].map(|tensor| tensor.to_contiguous());
        let (out, norm) = rows::batch_norm(values(&x), values(&gamma), values(&beta), slope);
        layer(out, &norm)
    }

    fn layer_norm(x: FlexTensor, scale: FlexTensor, shift: FlexTensor) -> FlexTensor {
        let [x, scale, shift] = [x, scale, shift].map(|tensor| tensor.to_contiguous());
        table(rows::layer_norm(values(&x), values(&scale), values(&shift)), values(&scale).len())
    }

    fn group_max(x: FlexTensor, size: usize) -> FlexTensor {
        let x = x.to_contiguous();
        let channels = x.layout().shape()[1];
        table(pool_kernel::groups(values(&x), channels, size).0, channels)
    }
}

impl<C: CheckpointStrategy> RowOperations for Autodiff<Flex, C> {
    fn attention(
        queries: FloatTensor<Self>,
        keys: FloatTensor<Self>,
        of: FloatTensor<Self>,
        shape: Shape,
    ) -> FloatTensor<Self> {
        let parents = [&queries, &keys, &of];
        let inputs = parents.map(|tensor| tensor.primitive().to_contiguous());
        let (out, logarithms) = attention_kernel::forward(inputs.each_ref().map(values), &shape);
        let out = found(out, &shape);
        let kept = out.clone();
        tracked::<C, 3>(parents, out, move |grad_out, _| {
            let inputs = inputs.each_ref().map(values);
            attention_kernel::backward(inputs, &shape, values(&kept), &logarithms, grad_out)
        })
    }

    fn dense(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        slope: f32,
    ) -> FloatTensor<Self> {
        let parents = [&x, &weight, &bias];
        let [x, weight, bias] = parents.map(|tensor| tensor.primitive().to_contiguous());
        let outputs = values(&bias).len();
        let out = table(rows::dense(values(&x), values(&weight), values(&bias), slope), outputs);
        let kept = out.clone();
        tracked::<C, 3>(parents, out, move |grad_out, [wants_x, ..]| {
            let (x, weight) = (values(&x), values(&weight));
            rows::dense_backward(x, weight, values(&kept), slope, grad_out, outputs, wants_x)
        })
    }

    fn batch_norm(
        x: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
        slope: f32,
    ) -> LayerOutput<Self> {
        let parents = [&x, &gamma, &beta];
        let [x, gamma, beta] = parents.map(|tensor| tensor.primitive().to_contiguous());
        let (out, norm) = rows::batch_norm(values(&x), values(&gamma), values(&beta), slope);
        let LayerOutput { values: out, mean, variance } = layer(out, &norm);
        let out = tracked::<C, 3>(parents, out, move |grad_out, _| {
            rows::batch_norm_backward(values(&x), &norm, slope, grad_out)
        });
        let lift = <Self as AutodiffBackend>::from_inner;
        LayerOutput { values: out, mean: lift(mean), variance: lift(variance) }
    }

    fn layer_norm(
        x: FloatTensor<Self>,
        scale: FloatTensor<Self>,
        shift: FloatTensor<Self>,
    ) -> FloatTensor<Self> {
        let parents = [&x, &scale, &shift];
        let [x, scale, shift] = parents.map(|tensor| tensor.primitive().to_contiguous());
        let out = rows::layer_norm(values(&x), values(&scale), values(&shift));
        let out = table(out, values(&scale).len());
        tracked::<C, 3>(parents, out, move |grad_out, _| {
            rows::layer_norm_backward(values(&x), values(&scale), grad_out)
        })
    }

    fn group_max(x: FloatTensor<Self>, size: usize) -> FloatTensor<Self> {
        let inner = x.primitive().to_contiguous();
        let channels = inner.layout().shape()[1];
        let (out, winners) = pool_kernel::groups(values(&inner), channels, size);
        tracked::<C, 1>([&x], table(out, channels), move |grad_out, _| {
            [pool_kernel::groups_backward(grad_out, &winners, channels, size)]
        })
    }
}
