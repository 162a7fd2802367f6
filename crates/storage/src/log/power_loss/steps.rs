//! Reconstructs the contents of the disk after some of the steps and a loss of power.

use super::{Node, PIECE, Step};
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

/// Random numbers from a seed (Steele et al. 2014, SplitMix64).
#[derive(Debug)]
pub(super) struct Dice(pub(super) u64);

impl Dice {
    pub(super) fn below(&mut self, bound: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        usize::try_from((mixed ^ (mixed >> 31)) % bound.max(1) as u64).unwrap_or(0)
    }
}

/// What happens to unsynced changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fate {
    /// All are there.
    Kept,
    /// None is there.
    Lost,
    /// Decided for each change: there, not there, or in part.
    Mixed,
}

#[derive(Debug, Default)]
struct File {
    synced: Vec<u8>,
    pending: Vec<Change>,
}

#[derive(Debug, Clone)]
enum Change {
    Write { offset: usize, bytes: Vec<u8> },
    Cut { length: usize },
}

#[derive(Debug, Default)]
struct Directory {
    synced: BTreeMap<String, Node>,
    pending: Vec<Naming>,
}

#[derive(Debug, Clone)]
enum Naming {
    Link { name: String, node: Node },
    Rename { from: String, to: String, node: Node },
    Unlink { name: String },
}

#[derive(Debug, Default)]
struct Platter {
    files: BTreeMap<Node, File>,
    directories: BTreeMap<Node, Directory>,
}

/// Creates at `target` the contents of the disk after these steps and a loss of power.
pub(super) fn after(steps: &[Step], fate: Fate, dice: &mut Dice, target: &Path) {
    let mut platter = Platter::default();
    platter.directories.insert(0, Directory::default());
    for step in steps {
        platter.take(step);
    }
    platter.lose_power(fate, dice);
    platter.write(0, target);
}

impl Platter {
    fn take(&mut self, step: &Step) {
        match step.clone() {
            Step::Write { file, offset, bytes } => self.file(file).pending.push(Change::Write { offset, bytes }),
            Step::Cut { file, length } => self.file(file).pending.push(Change::Cut { length }),
            Step::SyncFile(file) => self.file(file).sync(),
            Step::Link { directory, name, node, is_directory } => {
                if is_directory {
                    self.directories.insert(node, Directory::default());
                } else {
                    self.files.insert(node, File::default());
                }
                self.directory(directory).pending.push(Naming::Link { name, node });
            }
            Step::Rename { directory, from, to, node } => {
                self.directory(directory).pending.push(Naming::Rename { from, to, node });
            }
            Step::Unlink { directory, name } => self.directory(directory).pending.push(Naming::Unlink { name }),
            Step::SyncDirectory(directory) => self.directory(directory).sync(),
            Step::Acknowledged { .. } | Step::Copied { .. } => {}
        }
    }

    fn lose_power(&mut self, fate: Fate, dice: &mut Dice) {
        for file in self.files.values_mut() {
            for change in std::mem::take(&mut file.pending) {
                let torn = match fate {
                    Fate::Kept => Some(change),
                    Fate::Lost => None,
                    Fate::Mixed => match dice.below(3) {
                        0 => None,
                        1 => Some(change),
                        _ => {
                            change
                                .pieces()
                                .into_iter()
                                .filter(|_| dice.below(2) == 0)
                                .for_each(|piece| file.apply(&piece));
                            None
                        }
                    },
                };
                torn.iter().for_each(|change| file.apply(change));
            }
        }
        for directory in self.directories.values_mut() {
            for naming in std::mem::take(&mut directory.pending) {
                if fate == Fate::Kept || (fate == Fate::Mixed && dice.below(2) == 0) {
                    directory.apply(&naming);
                }
            }
        }
    }

    fn write(&self, directory: Node, target: &Path) {
        for (name, node) in &self.directories[&directory].synced {
            let path = target.join(name);
            if self.directories.contains_key(node) {
                fs::create_dir(&path).expect("a directory of a test");
                self.write(*node, &path);
            } else {
                fs::write(&path, &self.files[node].synced).expect("a file of a test");
            }
        }
    }

    fn file(&mut self, node: Node) -> &mut File {
        self.files.entry(node).or_default()
    }

    fn directory(&mut self, node: Node) -> &mut Directory {
        self.directories.entry(node).or_default()
    }
}

impl Change {
    fn pieces(&self) -> Vec<Change> {
        match self {
            Change::Cut { .. } => vec![self.clone()],
            Change::Write { offset, bytes } => bytes
                .chunks(PIECE)
                .enumerate()
                .map(|(index, piece)| Change::Write { offset: offset + index * PIECE, bytes: piece.to_vec() })
                .collect(),
        }
    }
}

impl File {
    fn apply(&mut self, change: &Change) {
        match change {
            Change::Cut { length } => self.synced.truncate(*length),
            Change::Write { offset, bytes } => {
                let end = offset + bytes.len();
                if self.synced.len() < end {
                    self.synced.resize(end, 0);
                }
                self.synced[*offset..end].copy_from_slice(bytes);
            }
        }
    }

    fn sync(&mut self) {
        for change in std::mem::take(&mut self.pending) {
            self.apply(&change);
        }
    }
}

impl Directory {
    fn apply(&mut self, naming: &Naming) {
        match naming {
            Naming::Link { name, node } => drop(self.synced.insert(name.clone(), *node)),
            Naming::Unlink { name } => drop(self.synced.remove(name)),
            Naming::Rename { from, to, node } => {
                if self.synced.get(from) == Some(node) {
                    self.synced.remove(from);
                }
                self.synced.insert(to.clone(), *node);
            }
        }
    }

    fn sync(&mut self) {
        for naming in std::mem::take(&mut self.pending) {
            self.apply(&naming);
        }
    }
}
