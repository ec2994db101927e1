//! What a run needs to go on as if it had never stopped: one file, written atomically.

use std::fs;
use std::path::Path;

use burn::optim::ModuleOptimizer;
use burn::tensor::{Bytes, Device};
use safetensors::tensor::Dtype;
use serde::{Deserialize, Serialize};
use upcr::{Error, Result};

use super::config::TrainingConfig;
use super::history::History;
use crate::files::write_atomically;
use crate::models::Learned;
use crate::models::tensor_file::{StoredTensor, TensorFile};

const OPTIMIZER: &str = "optimizer";
const STATE_KEY: &str = "upcr.training";

/// Where a run is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct State {
    pub config: TrainingConfig,
    /// Tells apart what adaptations start from.
    #[serde(default)]
    pub origin: u64,
    /// Steps done.
    pub step: u64,
    /// Seconds spent.
    pub seconds: f64,
    pub history: History,
}

pub(super) fn save(path: &Path, state: &State, network: &Learned, optimizer: &ModuleOptimizer) -> Result<()> {
    let failed = |reason: String| Error::InvalidSetting { name: "checkpoint", reason };
    let mut file = network.store();
    let bytes = optimizer.into_bytes().map_err(|e| failed(e.to_string()))?.to_vec();
    let stored = StoredTensor { dtype: Dtype::U8, shape: vec![bytes.len()], bytes };
    file.tensors.insert(OPTIMIZER.into(), stored);
    let state = serde_json::to_string(state).map_err(|e| failed(e.to_string()))?;
    file.metadata.insert(STATE_KEY.into(), state);
    write_atomically(path, &file.to_bytes()?)
}

pub(super) fn load(
    path: &Path,
    optimizer: ModuleOptimizer,
    device: &Device,
) -> Result<(State, Learned, ModuleOptimizer)> {
    let malformed = |reason: String| Error::Malformed { path: path.into(), format: "checkpoint", reason };
    let bytes = fs::read(path).map_err(|source| Error::Io { path: path.into(), source })?;
    let file = TensorFile::from_bytes(&bytes, path)?;
    let state = file.metadata.get(STATE_KEY).ok_or_else(|| malformed(format!("has no {STATE_KEY}")))?;
    let state = serde_json::from_str(state).map_err(|e| malformed(format!("{STATE_KEY}: {e}")))?;
    let network = Learned::restore(&file, path, device)?;
    let stored = file.tensors.get(OPTIMIZER).ok_or_else(|| malformed(format!("has no {OPTIMIZER}")))?;
    let optimizer = optimizer
        .from_bytes(Bytes::from_bytes_vec(stored.bytes.clone()))
        .map_err(|e| malformed(format!("{OPTIMIZER}: {e}")))?;
    Ok((state, network, optimizer))
}
