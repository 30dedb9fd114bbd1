//! The ROS 2 types of one flow: where definitions come from, and the compiled ones.
//!
//! ```text
//! message ─► known? ─► compiled ─► converted at once
//!              └ no ─► pool: get ─► built in, folders, added ─► compiled, or unknown for 5 s
//!                                                    ▲                     └ wish
//!                            flow/definitions.rs: add └── nodes, flows ◄────────┘
//! ```
//!
//! Three locks, never held together: that of the definitions is held while a search begins, not
//! while it reads files; that of the compiled types, and that of those sought with others, for one
//! look-up.

mod cache;
mod convert;
mod parts;
mod seek;

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_convert::{
    Definition, Definitions, DescriptionError, Distro, Folders, Program, Source, TypeDescription,
    TypeHash, Warning,
};
use blaze_domain::WhyCode;
use blaze_domain::node_file::Ros2Distro;
use parking_lot::Mutex;
use tokio::sync::{mpsc, watch};

use cache::Cache;
pub use convert::{CompiledType, Conversion, ConvertFailure, Converted, Encoding};
pub(crate) use parts::{Parts, parts_of};
pub use seek::Wish;
pub(crate) use seek::{Others, SEARCH, seek};

/// How long an unknown type is not sought again: a file may have come, or a node have answered.
const RETRY: Duration = Duration::from_secs(5);

/// Name and hash of a type, as a publisher or requester gives them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct MessageType<T = String> {
    /// `sensor_msgs/msg/Imu`
    pub name: T,
    /// RIHS01 hash, or empty.
    pub hash: T,
}

/// Types of sensor data whose messages are mostly large. RustDDS keeps so many samples of a topic
/// as its first reader had room for, and never fewer: where only the first image told that it is
/// large, a thousand images stayed in memory.
const LARGE_TYPES: [&str; 8] = [
    "grid_map_msgs/msg/GridMap",
    "nav_msgs/msg/OccupancyGrid",
    "octomap_msgs/msg/Octomap",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/PointCloud",
    "sensor_msgs/msg/PointCloud2",
    "stereo_msgs/msg/DisparityImage",
];

impl MessageType {
    /// Whether large messages are to be expected, before one has come.
    #[must_use]
    pub fn is_large(&self) -> bool {
        LARGE_TYPES.contains(&self.name.as_str())
    }

    /// The same, borrowed.
    #[must_use]
    pub fn borrowed(&self) -> MessageType<&str> {
        MessageType { name: &self.name, hash: &self.hash }
    }
}

impl MessageType<&str> {
    /// The same with texts of its own.
    #[must_use]
    pub fn owned(self) -> MessageType {
        MessageType { name: self.name.to_owned(), hash: self.hash.to_owned() }
    }
}

/// What leases say of the types of a topic.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct TopicTypes {
    /// Type of CDR that names none.
    pub published: Option<MessageType>,
    /// Type that JSON becomes for readers of the own ROS 2 network.
    pub wanted: Wanted,
}

/// A type that readers ask for.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Wanted {
    /// No reader names one.
    #[default]
    Nothing,
    /// This one.
    Type(MessageType),
    /// Not that of the publisher, or several: the facts, for people.
    Mismatch(String),
}

/// What was found of a type.
type Found = Result<Arc<CompiledType>, ConvertFailure>;

/// All types of one flow.
#[derive(Debug)]
pub struct Types {
    sources: Mutex<Sources>,
    compiled: Mutex<Cache>,
    sought: Sought,
}

/// Types that are sought with others.
#[derive(Debug, Default)]
struct Sought {
    pending: Mutex<BTreeSet<MessageType>>,
    /// To those who seek them; `None`: nobody does.
    wishes: Option<mpsc::Sender<Wish>>,
    /// Changes whenever a search has ended.
    ended: watch::Sender<()>,
}

/// Where definitions come from. They are read at the first search: a flow that converts nothing
/// holds none.
#[derive(Debug)]
struct Sources {
    distro: Distro,
    folders: Vec<PathBuf>,
    definitions: Option<Arc<Definitions>>,
}

impl Default for Types {
    /// The built-in types alone.
    fn default() -> Self {
        Self::new(Distro::Jazzy, Vec::new())
    }
}

impl Types {
    /// The built-in types of a release, and folders in the order in which they are searched. A
    /// folder that is not there is a warning in the log.
    #[must_use]
    pub fn new(distro: Distro, folders: Vec<PathBuf>) -> Self {
        warn_of_missing(&folders);
        let sources = Sources { distro, folders, definitions: None };
        Self { sources: Mutex::new(sources), compiled: Mutex::default(), sought: Sought::default() }
    }

    /// The same, which lets others seek what it does not find itself.
    #[must_use]
    pub fn asking(mut self, wishes: mpsc::Sender<Wish>) -> Self {
        self.sought.wishes = Some(wishes);
        self
    }

    /// Other folders. All types are sought anew.
    pub fn set_folders(&self, folders: Vec<PathBuf>) {
        {
            let mut sources = self.sources.lock();
            if sources.folders == folders {
                return;
            }
            warn_of_missing(&folders);
            let Sources { distro, definitions, .. } = &*sources;
            let anew = |old: &Arc<Definitions>| {
                let (new, _) = Definitions::clone(old).reloaded(*distro, folders.clone());
                Arc::new(new)
            };
            sources.definitions = definitions.as_ref().map(anew);
            sources.folders = folders;
        }
        self.compiled.lock().clear();
    }

    /// Takes the definition that a node or another flow has sent.
    ///
    /// # Errors
    /// As [`Definitions::add`].
    pub fn add(
        &self,
        source: Source,
        description: TypeDescription,
    ) -> Result<(), DescriptionError> {
        let name = description.type_description.type_name.clone();
        let mut sources = self.sources.lock();
        Arc::make_mut(sources.definitions()).add(source, description)?;
        drop(sources);
        self.compiled.lock().forget_unknown(&name);
        Ok(())
    }

    /// A type that was sought before. `None`: it was not, or is to be sought again. Never waits
    /// for a file.
    #[must_use]
    pub fn known(&self, now: Instant, ty: MessageType<&str>) -> Option<Found> {
        self.compiled.lock().get(now, ty)
    }

    /// A type. Reads files if it was not sought before.
    ///
    /// # Errors
    /// If nobody has its definition, or it cannot be converted.
    pub fn get(&self, now: Instant, ty: MessageType<&str>) -> Found {
        if let Some(found) = self.known(now, ty) {
            return found;
        }
        let found = self.seek(ty);
        self.compiled.lock().put(now + RETRY, ty, found.clone());
        found
    }

    /// Seeks a definition in what this flow has, and compiles it. Another one is wished for: it
    /// comes by [`add`](Self::add), for the messages after it.
    fn seek(&self, ty: MessageType<&str>) -> Found {
        match self.find(ty) {
            Some(found) => compile(ty.name, &found),
            None => {
                self.wish(ty);
                let name = ty.name;
                let with = if ty.hash.is_empty() { "" } else { " with the hash " };
                let detail = format!("no definition of {name}{with}{}", ty.hash);
                Err(ConvertFailure::new(WhyCode::TypeUnknown, detail))
            }
        }
    }

    /// Lets a type be found before the first message that needs it. One that was sought a moment
    /// ago is not sought again.
    pub fn prepare(&self, now: Instant, ty: MessageType<&str>) {
        if self.known(now, ty).is_none() {
            self.wish(ty);
        }
    }

    /// Lets others seek a definition. Where too many are sought it is dropped: the next message
    /// wishes for it again.
    fn wish(&self, ty: MessageType<&str>) {
        let Some(wishes) = &self.sought.wishes else { return };
        let ty = ty.owned();
        if self.sought.pending.lock().insert(ty.clone())
            && wishes.try_send(Wish { ty: ty.clone(), asker: None }).is_err()
        {
            self.sought.pending.lock().remove(&ty);
        }
    }

    /// Whether others are asked for the definition of a type.
    #[must_use]
    pub fn is_sought(&self, ty: &MessageType) -> bool {
        self.sought.pending.lock().contains(ty)
    }

    /// Others have been asked for a definition, whatever came of it.
    pub(crate) fn sought(&self, ty: &MessageType) {
        self.sought.pending.lock().remove(ty);
        self.sought.ended.send_replace(());
    }

    /// Changes whenever a search with others has ended.
    pub(crate) fn searches(&self) -> watch::Receiver<()> {
        self.sought.ended.subscribe()
    }

    /// The definition of a type, from what this flow has.
    #[must_use]
    pub fn find(&self, ty: MessageType<&str>) -> Option<Definition> {
        let hash: Option<TypeHash> = match ty.hash {
            "" => None,
            text => Some(text.parse().ok()?),
        };
        let definitions = Arc::clone(self.sources.lock().definitions());
        let mut warnings = Vec::new();
        let found = definitions.find(ty.name, hash, &mut warnings);
        warnings.iter().for_each(warn);
        found
    }
}

impl Sources {
    fn definitions(&mut self) -> &mut Arc<Definitions> {
        let Self { distro, folders, definitions } = self;
        definitions.get_or_insert_with(|| {
            let (new, _) = Definitions::new(*distro, folders.clone());
            Arc::new(new)
        })
    }
}

fn compile(name: &str, found: &Definition) -> Found {
    let program = Program::compile(&found.description).map_err(|error| {
        ConvertFailure::new(WhyCode::ConvertError, format!("{name} is not converted: {error}"))
    })?;
    tracing::debug!(name, source = %found.source, hash = %found.hash, "a type was compiled");
    Ok(Arc::new(CompiledType { name: name.to_owned(), hash: found.hash, program }))
}

fn warn_of_missing(folders: &[PathBuf]) {
    Folders::new(folders.to_vec()).1.iter().for_each(warn);
}

fn warn(warning: &Warning) {
    tracing::warn!(path = %warning.path.display(), "definitions of types: {}", warning.text);
}

/// The release whose definitions are taken for one of a node file. Those that are not built in
/// take the nearest; hashes tell where that differs.
#[must_use]
pub fn built_in_for(distro: Ros2Distro) -> Distro {
    match distro {
        Ros2Distro::Humble => Distro::Humble,
        Ros2Distro::Iron | Ros2Distro::Jazzy => Distro::Jazzy,
        Ros2Distro::Kilted | Ros2Distro::Lyrical | Ros2Distro::Rolling => Distro::Kilted,
    }
}

#[cfg(test)]
mod tests;
