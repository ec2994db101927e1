//! Depth images: 16-bit grey PNG, each pixel the depth along the optical axis.

use crate::PointCloud;

use super::input::{Fallible, Fault, Input, check_expansion, malformed, unsupported};
use super::{Format, Intrinsics, ReadOptions, Reader};

pub(super) const FORMAT: Format = Format {
    name: "depth PNG",
    extensions: &["png"],
    read: Reader::Cloud(read),
    write: None,
    comments: None,
};

/// A Kinect's depth camera, and the image size it belongs to.
const KINECT: Intrinsics = Intrinsics { fx: 585.0, fy: 585.0, cx: 320.0, cy: 240.0 };
const KINECT_SIZE: (u32, u32) = (640, 480);

/// Depths that mean "none".
const NO_DEPTH: [u16; 2] = [0, u16::MAX];

impl From<png::DecodingError> for Fault {
    fn from(error: png::DecodingError) -> Self {
        match error {
            png::DecodingError::IoError(error) => error.into(),
            other => Self::Malformed(other.to_string()),
        }
    }
}

/// In metres, x right, y down, z ahead, seen from the origin.
fn read(input: &mut Input, options: &ReadOptions) -> Fallible<PointCloud> {
    if !(options.depth_scale.is_finite() && options.depth_scale > 0.0) {
        return unsupported(format!("{} depth units per metre", options.depth_scale));
    }
    let mut image = png::Decoder::new(&mut input.stream).read_info()?;
    let info = image.info();
    if (info.color_type, info.bit_depth) != (png::ColorType::Grayscale, png::BitDepth::Sixteen) {
        return unsupported("the image is not 16-bit grey, so not a depth image");
    }
    if info.interlaced {
        return unsupported("interlaced depth images cannot be read");
    }
    let (size, rows) = (info.size(), info.height);
    check_expansion(input.len, u64::from(size.0) * u64::from(size.1))?;
    let camera = match options.intrinsics {
        Some(camera) => camera,
        None if size == KINECT_SIZE => KINECT,
        None => {
            let (width, height) = size;
            return unsupported(format!("a depth image of {width}×{height} needs its camera's intrinsics"));
        }
    };
    let mut points = Vec::new();
    for v in 0..rows {
        let Some(row) = image.next_row()? else { return malformed("the image has too few rows") };
        for (u, pixel) in row.data().chunks_exact(2).enumerate() {
            let depth = u16::from_be_bytes([pixel[0], pixel[1]]);
            if !NO_DEPTH.contains(&depth) {
                let z = f64::from(depth) / options.depth_scale;
                points.push([
                    z * (u as f64 - camera.cx) / camera.fx,
                    z * (f64::from(v) - camera.cy) / camera.fy,
                    z,
                ]);
            }
        }
    }
    Ok(PointCloud { points, viewpoint: Some([0.0; 3]), ..PointCloud::default() })
}
