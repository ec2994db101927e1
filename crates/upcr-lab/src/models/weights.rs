//! UPCR's weights in the layout that the product library reads.

use std::path::Path;

use burn::tensor::Device;
use upcr::Result;
use upcr::net::NetworkConfig;

use super::named;
use super::tensor_file::{TensorFile, malformed};
use super::upcr::{Upcr, init};
use crate::random;

/// Metadata key under which the configuration stands.
const CONFIG_KEY: &str = "upcr.config";

/// The name in files of a field: the second branch's first map is a field beside the branch, and in files within it.
fn stored_name(field: &str) -> String {
    if field.starts_with("embed.") { format!("invariant.{field}") } else { field.to_owned() }
}

/// The network's weights with its configuration.
pub fn store(network: &Upcr) -> TensorFile {
    let mut file = TensorFile::default();
    // A configuration of numbers and names has no value that JSON lacks.
    let config = serde_json::to_string(&network.config).unwrap_or_default();
    file.metadata.insert(CONFIG_KEY.into(), config);
    file.metadata.insert("upcr.version".into(), env!("CARGO_PKG_VERSION").into());
    let tensors = named::tensors(network).into_iter();
    file.tensors = tensors.map(|(field, tensor)| (stored_name(&field), tensor)).collect();
    file
}

/// The network that a file holds.
///
/// # Errors
/// Where its configuration or a weight is missing or does not fit; `path` is what errors name.
pub fn restore(file: &TensorFile, path: &Path, device: &Device) -> Result<Upcr> {
    let config = file
        .metadata
        .get(CONFIG_KEY)
        .ok_or_else(|| malformed(path, format!("the metadata have no {CONFIG_KEY}")))?;
    let config: NetworkConfig =
        serde_json::from_str(config).map_err(|e| malformed(path, format!("{CONFIG_KEY}: {e}")))?;
    let network = init(&config, &mut random::stream(0, 0), device)?;
    named::filled(network, file, path, stored_name)
}
