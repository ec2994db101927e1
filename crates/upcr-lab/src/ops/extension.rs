//! The operations as the framework sees them: differentiable functions of tensors.

use std::fmt;
use std::sync::Arc;

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, AutodiffBackend, Backend, Dispatch, ExtensionType, Flex, backend_extension};
use burn::tensor::{Bytes, DType, Device, Shape, Tensor};
use burn_flex::{FlexTensor, Layout};

use super::batch::BatchGraph;
use super::canonical_chamfer::PairPoints;
use super::edge_embed::EdgeInputs;
use super::graph_layer::{EdgeStatistics, Parameters};
use super::normalized::{Normalized, NormalizedMap};
use super::{canonical_chamfer as chamfer_kernel, edge_embed as embed_kernel, generic};
use super::{graph_layer as layer_kernel, pool as pool_kernel};

/// A graph layer on `features` `[rows, inputs]`; the map's weight is `[2 · inputs, outputs]`. Without `statistics`, the
/// batch's own normalise.
pub fn graph_layer(
    features: Tensor<2>,
    map: NormalizedMap,
    graph: &Arc<BatchGraph>,
    statistics: Option<[Tensor<1>; 2]>,
) -> Normalized {
    if !on_cpu(&features.device()) {
        return generic::graph_layer(features, map, graph, statistics);
    }
    let context =
        Context { graph: graph.clone(), negative_slope: map.negative_slope, statistics: fixed(statistics) };
    let [weight, gamma, beta] = dispatched(map);
    normalized(Dispatch::graph_layer(features.into_dispatch(), weight, gamma, beta, context))
}

/// The pose-invariant branch's first step; the map's weight is `[inputs.dim(), outputs]`.
pub fn edge_embed(
    inputs: &Arc<EdgeInputs>,
    map: NormalizedMap,
    graph: &Arc<BatchGraph>,
    statistics: Option<[Tensor<1>; 2]>,
) -> Normalized {
    if !on_cpu(&map.weight.device()) {
        return generic::edge_embed(inputs, map, graph, statistics);
    }
    let context =
        Context { graph: graph.clone(), negative_slope: map.negative_slope, statistics: fixed(statistics) };
    let [weight, gamma, beta] = dispatched(map);
    normalized(Dispatch::edge_embed(weight, gamma, beta, Data(inputs.clone()), context))
}

/// The largest value of every channel over each cloud's rows, `[clouds, channels]`.
pub fn pool_max(features: Tensor<2>, graph: &Arc<BatchGraph>) -> Tensor<2> {
    if !on_cpu(&features.device()) {
        return generic::pool_max(features, graph);
    }
    Tensor::from_dispatch(Dispatch::pool_max(features.into_dispatch(), Data(graph.clone())))
}

/// The Chamfer distance of every pair in canonical poses, `[pairs]`, from rotations `[clouds, 9]` and translations
/// `[clouds, 3]`.
pub fn canonical_chamfer(
    rotations: Tensor<2>,
    translations: Tensor<2>,
    clouds: &Arc<PairPoints>,
) -> Tensor<1> {
    if !on_cpu(&rotations.device()) {
        return generic::canonical_chamfer(rotations, translations, clouds);
    }
    let (rotations, translations) = (rotations.into_dispatch(), translations.into_dispatch());
    Tensor::from_dispatch(Dispatch::canonical_chamfer(rotations, translations, Data(clouds.clone())))
}

pub(super) fn on_cpu(device: &Device) -> bool {
    device.clone().inner() == Device::flex()
}

fn fixed(statistics: Option<[Tensor<1>; 2]>) -> Option<Arc<EdgeStatistics>> {
    let values = |tensor: Tensor<1>| tensor.into_data().iter::<f32>().collect();
    statistics
        .map(|[mean, variance]| Arc::new(EdgeStatistics { mean: values(mean), variance: values(variance) }))
}

fn dispatched(map: NormalizedMap) -> [FloatTensor<Dispatch>; 3] {
    [map.weight.into_dispatch(), map.gamma.into_dispatch(), map.beta.into_dispatch()]
}

pub(super) fn normalized(out: LayerOutput<Dispatch>) -> Normalized {
    Normalized {
        values: Tensor::from_dispatch(out.values),
        statistics: [Tensor::from_dispatch(out.mean), Tensor::from_dispatch(out.variance)],
    }
}

/// What a layer needs besides tensors.
#[derive(Debug, Clone)]
pub struct Context {
    graph: Arc<BatchGraph>,
    negative_slope: f32,
    statistics: Option<Arc<EdgeStatistics>>,
}

/// Shared data that no gradient flows to.
#[derive(Clone)]
pub struct Data<T>(Arc<T>);

impl<T> fmt::Debug for Data<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Data")
    }
}

/// Values and statistics of a layer.
#[derive(ExtensionType)]
#[allow(missing_docs)]
pub struct LayerOutput<B: Backend> {
    pub values: FloatTensor<B>,
    pub mean: FloatTensor<B>,
    pub variance: FloatTensor<B>,
}

/// The operations that a backend brings.
#[backend_extension(Flex, Autodiff)]
#[allow(missing_docs)]
pub trait CloudOperations: Backend {
    fn graph_layer(
        features: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
        context: Context,
    ) -> LayerOutput<Self>;

    fn edge_embed(
        weight: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
        inputs: Data<EdgeInputs>,
        context: Context,
    ) -> LayerOutput<Self>;

    fn pool_max(features: FloatTensor<Self>, graph: Data<BatchGraph>) -> FloatTensor<Self>;

    fn canonical_chamfer(
        rotations: FloatTensor<Self>,
        translations: FloatTensor<Self>,
        clouds: Data<PairPoints>,
    ) -> FloatTensor<Self>;
}

/// A tensor of the CPU backend that takes over `values`.
pub(super) fn tensor(values: Vec<f32>, shape: &[usize]) -> FlexTensor {
    let layout = Layout::contiguous(Shape::from(shape.to_vec()));
    FlexTensor::new(Bytes::from_elems(values), layout, DType::F32)
}

pub(super) fn values(tensor: &FlexTensor) -> &[f32] {
    // Networks here are single precision, and every tensor was made contiguous where it came in.
    tensor.as_slice::<f32>().unwrap_or_default()
}

fn columns(tensor: &FlexTensor) -> usize {
    tensor.layout().shape()[1]
}

fn parameters<'a>([weight, gamma, beta]: [&'a FlexTensor; 3], context: &Context) -> Parameters<'a> {
    Parameters {
        weight: values(weight),
        gamma: values(gamma),
        beta: values(beta),
        negative_slope: context.negative_slope,
    }
}

fn layer_output(out: Vec<f32>, statistics: EdgeStatistics) -> LayerOutput<Flex> {
    let outputs = statistics.mean.len();
    let rows = out.len() / outputs.max(1);
    LayerOutput {
        values: tensor(out, &[rows, outputs]),
        mean: tensor(statistics.mean, &[outputs]),
        variance: tensor(statistics.variance, &[outputs]),
    }
}

impl CloudOperations for Flex {
    fn graph_layer(
        features: FlexTensor,
        weight: FlexTensor,
        gamma: FlexTensor,
        beta: FlexTensor,
        context: Context,
    ) -> LayerOutput<Self> {
        let [features, weight, gamma, beta] =
            [features, weight, gamma, beta].map(|tensor| tensor.to_contiguous());
        let parameters = parameters([&weight, &gamma, &beta], &context);
        let features = values(&features);
        match &context.statistics {
            None => {
                let (out, statistics, _) = layer_kernel::forward(features, &parameters, &context.graph);
                layer_output(out, statistics)
            }
            Some(statistics) => {
                let out = layer_kernel::forward_with(features, &parameters, statistics, &context.graph);
                layer_output(out, EdgeStatistics::clone(statistics))
            }
        }
    }

    fn edge_embed(
        weight: FlexTensor,
        gamma: FlexTensor,
        beta: FlexTensor,
        inputs: Data<EdgeInputs>,
        context: Context,
    ) -> LayerOutput<Self> {
        let [weight, gamma, beta] = [weight, gamma, beta].map(|tensor| tensor.to_contiguous());
        let parameters = parameters([&weight, &gamma, &beta], &context);
        match &context.statistics {
            None => {
                let (out, statistics, _) = embed_kernel::forward(&inputs.0, &parameters, &context.graph);
                layer_output(out, statistics)
            }
            Some(statistics) => {
                let out = embed_kernel::forward_with(&inputs.0, &parameters, statistics, &context.graph);
                layer_output(out, EdgeStatistics::clone(statistics))
            }
        }
    }

    fn pool_max(features: FlexTensor, graph: Data<BatchGraph>) -> FlexTensor {
        let features = features.to_contiguous();
        let channels = columns(&features);
        let (out, _) = pool_kernel::forward(values(&features), channels, &graph.0.offsets);
        tensor(out, &[graph.0.clouds(), channels])
    }

    fn canonical_chamfer(
        rotations: FlexTensor,
        translations: FlexTensor,
        clouds: Data<PairPoints>,
    ) -> FlexTensor {
        let [rotations, translations] = [rotations, translations].map(|tensor| tensor.to_contiguous());
        let (losses, ..) = chamfer_kernel::forward(values(&rotations), values(&translations), &clouds.0);
        let pairs = losses.len();
        tensor(losses, &[pairs])
    }
}

/// State of an operation on its way back, of which nothing is worth printing.
#[derive(Clone)]
pub(super) struct Kept<T>(pub T);

impl<T> fmt::Debug for Kept<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Kept")
    }
}

impl<C: CheckpointStrategy> CloudOperations for Autodiff<Flex, C> {
    fn graph_layer(
        features: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
        context: Context,
    ) -> LayerOutput<Self> {
        #[derive(Debug)]
        struct GraphLayer;
        impl Backward<Flex, 4> for GraphLayer {
            type State = Kept<([FlexTensor; 4], Context, Arc<layer_kernel::Kept>)>;

            fn backward(self, ops: Ops<Self::State, 4>, grads: &mut Gradients, _: &mut Checkpointer) {
                let Kept(([features, weight, gamma, beta], context, kept)) = &ops.state;
                let grad_out = grads.consume::<Flex>(&ops.node).to_contiguous();
                let parameters = parameters([weight, gamma, beta], context);
                let found = layer_kernel::backward(
                    values(features),
                    &parameters,
                    &context.graph,
                    kept,
                    values(&grad_out),
                    ops.parents[0].is_some(),
                );
                let shapes = [features, weight, gamma, beta].map(|tensor| tensor.layout().shape().to_vec());
                let found = [found.features, found.weight, found.gamma, found.beta];
                for ((parent, found), shape) in ops.parents.into_iter().zip(found).zip(shapes) {
                    if let Some(parent) = parent {
                        grads.register::<Flex>(parent.id, tensor(found, &shape));
                    }
                }
            }
        }
        let nodes = [features.node(), weight.node(), gamma.node(), beta.node()];
        let inputs = [&features, &weight, &gamma, &beta].map(|tensor| tensor.primitive().to_contiguous());
        let parameters = parameters([&inputs[1], &inputs[2], &inputs[3]], &context);
        let (out, statistics, kept) = layer_kernel::forward(values(&inputs[0]), &parameters, &context.graph);
        let out = layer_output(out, statistics);
        let node = GraphLayer.prepare::<C>(nodes).compute_bound().stateful();
        let values = match node {
            OpsKind::Tracked(node) => node.finish(Kept((inputs, context, Arc::new(kept))), out.values),
            OpsKind::UnTracked(node) => node.finish(out.values),
        };
        let lift = <Self as AutodiffBackend>::from_inner;
        LayerOutput { values, mean: lift(out.mean), variance: lift(out.variance) }
    }

    fn edge_embed(
        weight: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
        inputs: Data<EdgeInputs>,
        context: Context,
    ) -> LayerOutput<Self> {
        #[derive(Debug)]
        struct EdgeEmbed;
        impl Backward<Flex, 3> for EdgeEmbed {
            type State = Kept<([FlexTensor; 3], Data<EdgeInputs>, Context, Arc<embed_kernel::Kept>)>;

            fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
                let Kept(([weight, gamma, beta], inputs, context, kept)) = &ops.state;
                let grad_out = grads.consume::<Flex>(&ops.node).to_contiguous();
                let parameters = parameters([weight, gamma, beta], context);
                let found =
                    embed_kernel::backward(&inputs.0, &parameters, &context.graph, kept, values(&grad_out));
                let shapes = [weight, gamma, beta].map(|tensor| tensor.layout().shape().to_vec());
                let found = [found.weight, found.gamma, found.beta];
                for ((parent, found), shape) in ops.parents.into_iter().zip(found).zip(shapes) {
                    if let Some(parent) = parent {
                        grads.register::<Flex>(parent.id, tensor(found, &shape));
                    }
                }
            }
        }
        let nodes = [weight.node(), gamma.node(), beta.node()];
        let tensors = [&weight, &gamma, &beta].map(|tensor| tensor.primitive().to_contiguous());
        let parameters = parameters([&tensors[0], &tensors[1], &tensors[2]], &context);
        let (out, statistics, kept) = embed_kernel::forward(&inputs.0, &parameters, &context.graph);
        let out = layer_output(out, statistics);
        let node = EdgeEmbed.prepare::<C>(nodes).compute_bound().stateful();
        let values = match node {
            OpsKind::Tracked(node) => {
                node.finish(Kept((tensors, inputs, context, Arc::new(kept))), out.values)
            }
            OpsKind::UnTracked(node) => node.finish(out.values),
        };
        let lift = <Self as AutodiffBackend>::from_inner;
        LayerOutput { values, mean: lift(out.mean), variance: lift(out.variance) }
    }

    fn pool_max(features: FloatTensor<Self>, graph: Data<BatchGraph>) -> FloatTensor<Self> {
        #[derive(Debug)]
        struct PoolMax;
        impl Backward<Flex, 1> for PoolMax {
            /// The winners, and the features' rows and channels.
            type State = Kept<(Arc<Vec<u32>>, usize, usize)>;

            fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
                let Kept((winners, rows, channels)) = ops.state;
                let grad_out = grads.consume::<Flex>(&ops.node).to_contiguous();
                let [parent] = ops.parents;
                if let Some(parent) = parent {
                    let found = pool_kernel::backward(values(&grad_out), &winners, channels, rows);
                    grads.register::<Flex>(parent.id, tensor(found, &[rows, channels]));
                }
            }
        }
        let inner = features.primitive().to_contiguous();
        let channels = columns(&inner);
        let (out, winners) = pool_kernel::forward(values(&inner), channels, &graph.0.offsets);
        let out = tensor(out, &[graph.0.clouds(), channels]);
        match PoolMax.prepare::<C>([features.node()]).compute_bound().stateful() {
            OpsKind::Tracked(node) => node.finish(Kept((Arc::new(winners), graph.0.rows(), channels)), out),
            OpsKind::UnTracked(node) => node.finish(out),
        }
    }

    fn canonical_chamfer(
        rotations: FloatTensor<Self>,
        translations: FloatTensor<Self>,
        clouds: Data<PairPoints>,
    ) -> FloatTensor<Self> {
        #[derive(Debug)]
        struct CanonicalChamfer;
        impl Backward<Flex, 2> for CanonicalChamfer {
            /// Gradients of each pair's loss.
            type State = Kept<Arc<[Vec<f32>; 2]>>;

            fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
                let Kept(found) = ops.state;
                let grad_out = grads.consume::<Flex>(&ops.node).to_contiguous();
                let grad_out = values(&grad_out);
                let pairs = grad_out.len();
                for (parent, found) in ops.parents.into_iter().zip(found.iter()) {
                    let Some(parent) = parent else { continue };
                    let width = found.len() / (2 * pairs);
                    let scaled = |(at, gradient): (usize, &f32)| gradient * grad_out[at / width % pairs];
                    let scaled = found.iter().enumerate().map(scaled).collect();
                    grads.register::<Flex>(parent.id, tensor(scaled, &[2 * pairs, width]));
                }
            }
        }
        let nodes = [rotations.node(), translations.node()];
        let inner = [&rotations, &translations].map(|tensor| tensor.primitive().to_contiguous());
        let (losses, grad_rotations, grad_translations) =
            chamfer_kernel::forward(values(&inner[0]), values(&inner[1]), &clouds.0);
        let pairs = losses.len();
        let losses = tensor(losses, &[pairs]);
        match CanonicalChamfer.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(node) => {
                node.finish(Kept(Arc::new([grad_rotations, grad_translations])), losses)
            }
            OpsKind::UnTracked(node) => node.finish(losses),
        }
    }
}
