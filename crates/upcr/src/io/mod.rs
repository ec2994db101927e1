//! Reading and writing clouds, meshes and transforms: one small file per format.
//!
//! The format is told by the file's extension; `FORMATS` lists them all. What is in memory is read and written by the
//! functions that take a stream, under a name that stands for the path. Coordinates are kept in the file's own frame
//! and unit. What a file claims is checked against its size before memory is allocated.

mod columns;
mod depth;
mod e57;
mod input;
mod kitti;
mod las;
mod lzf;
mod npy;
mod obj;
mod off;
mod output;
mod pcd;
mod ply;
mod scalar;
mod stl;
mod transform;
mod xyz;

#[cfg(test)]
mod tests;

use std::fs::File;
use std::io::{Read, Seek, Write};
use std::path::Path;

use crate::{Error, PointCloud, Result, TriangleMesh, hash::fnv1a};
use input::{Fallible, Fault, Input, malformed, unsupported};
use output::{Output, write_atomically, write_buffered};

pub use npy::write_array;
pub use transform::{read_transform, read_transform_from, write_transform};

/// A file format: its name, its extensions, and what can be done with it.
struct Format {
    name: &'static str,
    /// In lower case.
    extensions: &'static [&'static str],
    read: Reader,
    write: Option<Writer>,
    /// What its files say to people, where they have a place for that.
    comments: Option<CommentReader>,
}

type CommentReader = fn(&mut Input) -> Fallible<Vec<String>>;
type Writer = fn(&mut Output, &PointCloud, &WriteOptions) -> Fallible<()>;

/// What a format's files hold.
#[derive(Clone, Copy)]
enum Reader {
    /// Points.
    Cloud(fn(&mut Input, &ReadOptions) -> Fallible<PointCloud>),
    /// A surface, read as a cloud by sampling it.
    Mesh(fn(&mut Input) -> Fallible<TriangleMesh>),
    /// Points that may be a mesh's vertices; read as a cloud they are taken as they are.
    CloudOrMesh(
        fn(&mut Input, &ReadOptions) -> Fallible<PointCloud>,
        fn(&mut Input) -> Fallible<TriangleMesh>,
    ),
}

/// Every format there is. A new one is a file of its own and a line here.
static FORMATS: &[Format] = &[
    ply::FORMAT,
    pcd::FORMAT,
    las::FORMAT,
    las::COMPRESSED,
    e57::FORMAT,
    xyz::FORMAT,
    npy::FORMAT,
    kitti::FORMAT,
    off::FORMAT,
    obj::FORMAT,
    stl::FORMAT,
    depth::FORMAT,
];

/// Pinhole camera of a depth image, in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    /// Horizontal focal length.
    pub fx: f64,
    /// Vertical focal length.
    pub fy: f64,
    /// Column of the principal point.
    pub cx: f64,
    /// Row of the principal point.
    pub cy: f64,
}

/// How files are read that leave something open.
#[derive(Debug, Clone, PartialEq)]
pub struct ReadOptions {
    /// Points sampled on a mesh (OFF, OBJ, STL).
    pub mesh_samples: usize,
    /// Seed of that sampling, of which copies of a mesh that lie elsewhere make different points.
    pub seed: u64,
    /// Camera of a depth image; `None` takes a Kinect's 585 px focal length and centre (320, 240), which
    /// 640×480 images only may do.
    pub intrinsics: Option<Intrinsics>,
    /// Depth image units per metre.
    pub depth_scale: f64,
    /// Where the sensor stood, in the file's frame, where the file itself does not say.
    pub viewpoint: Option<[f64; 3]>,
}

impl Default for ReadOptions {
    fn default() -> Self {
        Self { mesh_samples: 100_000, seed: 0, intrinsics: None, depth_scale: 1000.0, viewpoint: None }
    }
}

/// How a cloud's numbers are stored, where the format has a choice (PLY, PCD); the others ignore it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Encoding {
    /// Little-endian binary.
    #[default]
    Binary,
    /// Text.
    Ascii,
    /// Compressed binary; PCD only.
    Compressed,
}

/// How files are written that leave something open.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct WriteOptions {
    /// How the numbers are stored.
    pub encoding: Encoding,
}

/// Reads a cloud with the default options, the format told by the file's extension.
///
/// A mesh (OFF, OBJ, STL) is sampled on its surface; one without faces, and every PLY, gives its vertices.
///
/// # Errors
/// [`Error::Io`], [`Error::Malformed`] or [`Error::Unsupported`], each naming the file.
pub fn read_cloud(path: impl AsRef<Path>) -> Result<PointCloud> {
    read_cloud_with(path, &ReadOptions::default())
}

/// Reads a cloud as [`read_cloud`] does, with `options`.
///
/// # Errors
/// As [`read_cloud`].
pub fn read_cloud_with(path: impl AsRef<Path>, options: &ReadOptions) -> Result<PointCloud> {
    let path = path.as_ref();
    read_cloud_from(path, open_known(path)?, options)
}

/// Reads a cloud as [`read_cloud_with`] does, from memory or any stream. `name` stands for the path: its extension tells
/// the format, and errors name it.
///
/// ```
/// use std::io::Cursor;
/// use upcr::io::{ReadOptions, read_cloud_from};
///
/// let cloud = read_cloud_from("scan.xyz", Cursor::new("1 2 3\n4 5 6\n"), &ReadOptions::default())?;
/// assert_eq!(cloud.points, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
/// # Ok::<(), upcr::Error>(())
/// ```
///
/// # Errors
/// As [`read_cloud`].
pub fn read_cloud_from(
    name: impl AsRef<Path>,
    stream: impl Read + Seek,
    options: &ReadOptions,
) -> Result<PointCloud> {
    let name = name.as_ref();
    let format = format_of(name)?;
    take(name, format.name, stream, |input| cloud_of(format, input, options))
}

/// What a file says to people: the comments in the header of a PLY. Those of other formats are notes to programs: there are none.
///
/// # Errors
/// As [`read_cloud`].
pub fn read_comments(path: impl AsRef<Path>) -> Result<Vec<String>> {
    let path = path.as_ref();
    read_comments_from(path, open_known(path)?)
}

/// Reads comments as [`read_comments`] does, from memory or any stream, named as for [`read_cloud_from`].
///
/// # Errors
/// As [`read_cloud`].
pub fn read_comments_from(name: impl AsRef<Path>, stream: impl Read + Seek) -> Result<Vec<String>> {
    let name = name.as_ref();
    let format = format_of(name)?;
    format.comments.map_or(Ok(Vec::new()), |read| take(name, format.name, stream, read))
}

/// Reads a mesh: OFF, OBJ, STL, or the vertices and faces of a PLY. Polygons are cut into fans of triangles.
///
/// # Errors
/// As [`read_cloud`]; [`Error::Unsupported`] where the format holds no mesh.
pub fn read_mesh(path: impl AsRef<Path>) -> Result<TriangleMesh> {
    let path = path.as_ref();
    read_mesh_from(path, open_known(path)?)
}

/// Reads a mesh as [`read_mesh`] does, from memory or any stream, named as for [`read_cloud_from`].
///
/// # Errors
/// As [`read_mesh`].
pub fn read_mesh_from(name: impl AsRef<Path>, stream: impl Read + Seek) -> Result<TriangleMesh> {
    let name = name.as_ref();
    let format = format_of(name)?;
    take(name, format.name, stream, |input| mesh_of(format, input))
}

/// Writes a cloud with the default options, the format told by the file's extension.
///
/// The file appears whole or not at all. Each format keeps what it can hold of normals, colours and viewpoint.
///
/// # Errors
/// [`Error::Io`], or [`Error::Unsupported`] where the format cannot be written or cannot hold the cloud.
pub fn write_cloud(path: impl AsRef<Path>, cloud: &PointCloud) -> Result<()> {
    write_cloud_with(path, cloud, &WriteOptions::default())
}

/// Writes a cloud as [`write_cloud`] does, with `options`.
///
/// # Errors
/// As [`write_cloud`].
pub fn write_cloud_with(path: impl AsRef<Path>, cloud: &PointCloud, options: &WriteOptions) -> Result<()> {
    let path = path.as_ref();
    let (format, write) = writer_of(path)?;
    write_atomically(path, |output| write(output, cloud, options)).map_err(|f| explain(path, format.name, f))
}

/// Writes a cloud as [`write_cloud_with`] does, to memory or any stream, named as for [`read_cloud_from`]. The stream is to
/// be empty: what was there is neither cut off nor, where writing fails, brought back.
///
/// # Errors
/// As [`write_cloud`].
pub fn write_cloud_to(
    name: impl AsRef<Path>,
    stream: impl Read + Write + Seek + Send + Sync,
    cloud: &PointCloud,
    options: &WriteOptions,
) -> Result<()> {
    let name = name.as_ref();
    let (format, write) = writer_of(name)?;
    write_buffered(stream, |output| write(output, cloud, options)).map_err(|f| explain(name, format.name, f))
}

/// Whether `path`'s extension tells a format that can be written: to be asked before long work.
///
/// # Errors
/// [`Error::Unsupported`] where it does not.
pub fn check_writable(path: impl AsRef<Path>) -> Result<()> {
    writer_of(path.as_ref()).map(|_| ())
}

fn writer_of(path: &Path) -> Result<(&'static Format, Writer)> {
    let format = format_of(path)?;
    let unwritable = || Fault::Unsupported(format!("{} files can be read but not written", format.name));
    match format.write {
        Some(write) => Ok((format, write)),
        None => Err(explain(path, format.name, unwritable())),
    }
}

/// Name of the format that `path`'s extension tells; `None` for an unknown one.
pub fn format_name(path: impl AsRef<Path>) -> Option<&'static str> {
    find_format(path.as_ref()).map(|format| format.name)
}

/// The extensions that can be read, and whether each can be written too.
pub fn extensions() -> impl Iterator<Item = (&'static str, bool)> {
    FORMATS.iter().flat_map(|f| f.extensions.iter().map(|&e| (e, f.write.is_some())))
}

fn cloud_of(format: &Format, input: &mut Input, options: &ReadOptions) -> Fallible<PointCloud> {
    let cloud = match format.read {
        Reader::Cloud(read) | Reader::CloudOrMesh(read, _) => read(input, options)?,
        Reader::Mesh(read) => {
            let mesh = read(input)?;
            if mesh.triangles.is_empty() {
                PointCloud::from_points(mesh.vertices)
            } else {
                mesh.sample(options.mesh_samples, options.seed ^ place(&mesh))
            }
        }
    };
    Ok(PointCloud { viewpoint: cloud.viewpoint.or(options.viewpoint), ..cloud })
}

/// A number that differs where a mesh lies elsewhere: two copies of one are sampled at different points then, as two scans
/// are, and do not fit each other at one pose better than at all that look the same.
fn place(mesh: &TriangleMesh) -> u64 {
    let bytes: Vec<u8> = mesh.vertices.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    fnv1a(&bytes)
}

fn mesh_of(format: &Format, input: &mut Input) -> Fallible<TriangleMesh> {
    match format.read {
        Reader::Mesh(read) | Reader::CloudOrMesh(_, read) => read(input),
        Reader::Cloud(_) => unsupported(format!("{} files hold no mesh", format.name)),
    }
}

/// Cuts a polygon into a fan of triangles; a point or an edge gives none.
fn push_fan(corners: &[u32], triangles: &mut Vec<[u32; 3]>) {
    if let [first, rest @ ..] = corners {
        triangles.extend(rest.windows(2).map(|pair| [*first, pair[0], pair[1]]));
    }
}

/// Fails where a triangle names a vertex that is not there.
fn check_indices(mesh: &TriangleMesh) -> Fallible<()> {
    let count = mesh.vertices.len();
    match mesh.triangles.iter().flatten().find(|&&v| v as usize >= count) {
        Some(v) => malformed(format!("a face names vertex {v} (from 0), but there are {count} vertices")),
        None => Ok(()),
    }
}

/// Opens a file whose extension is to tell its format.
fn open_known(path: &Path) -> Result<File> {
    format_of(path)?;
    open(path)
}

fn open(path: &Path) -> Result<File> {
    let open = || {
        let file = File::open(path)?;
        if file.metadata()?.is_dir() { Err(std::io::ErrorKind::IsADirectory.into()) } else { Ok(file) }
    };
    open().map_err(|source| Error::Io { path: path.to_owned(), source })
}

/// Reads what is to be of `format` from `stream`, which errors call `name`.
fn take<T>(
    name: &Path,
    format: &'static str,
    stream: impl Read + Seek,
    read: impl FnOnce(&mut Input) -> Fallible<T>,
) -> Result<T> {
    let take = || {
        let mut input = Input::new(stream)?;
        if input.len == 0 { malformed("the file is empty") } else { read(&mut input) }
    };
    take().map_err(|fault| explain(name, format, fault))
}

fn find_format(path: &Path) -> Option<&'static Format> {
    let extension = path.extension()?.to_str()?.to_ascii_lowercase();
    FORMATS.iter().find(|format| format.extensions.contains(&extension.as_str()))
}

fn format_of(path: &Path) -> Result<&'static Format> {
    find_format(path).ok_or_else(|| {
        let known: Vec<_> = extensions().map(|(extension, _)| extension).collect();
        let reason = format!("its extension tells no known format; known are {}", known.join(", "));
        Error::Unsupported { path: path.to_owned(), reason }
    })
}

/// Fails where a coordinate is NaN or infinite, which `format` has no way to write.
fn check_finite(cloud: &PointCloud, format: &str) -> Fallible<()> {
    match cloud.points.iter().position(|p| p.iter().any(|v| !v.is_finite())) {
        Some(i) => {
            unsupported(format!("point {i} has a NaN or infinite coordinate, which {format} cannot hold"))
        }
        None => Ok(()),
    }
}

/// Gives a fault its file and its format's name.
fn explain(path: &Path, format: &'static str, fault: Fault) -> Error {
    let path = path.to_owned();
    match fault {
        Fault::Io(source) => Error::Io { path, source },
        Fault::Malformed(reason) => Error::Malformed { path, format, reason },
        Fault::Unsupported(reason) => Error::Unsupported { path, reason },
    }
}
