//! The config of a whole system: one TOML file with a section for each role.

use super::catalogue;
use crate::arguments::SystemArguments;
use crate::failure::Failure;
use crate::input;
use anyhow::Context;
use ratn_cell::MIDDLE;
use ratn_cell::config::{AIMM, CellConfig};
use ratn_cell::core::protocol::Module;
use ratn_daemon::config::Check;
use ratn_daemon::process_manager::{self, ProcessManagerConfig, Template};
use ratn_daemon::resource_manager::{self, ResourceManagerConfig};
use ratn_daemon::service::ServiceConfig;
use ratn_daemon::world_pool::{self, WorldPoolConfig};
use ratn_model::catalogue::{Catalogue, JointChain, ResourceOffer};
use ratn_model::resource::{Quantity, ResourceClass};
use ratn_model::value::Value;
use ratn_motion::description::DescriptionError;
use ratn_motion::robot::{Joint, Robot};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::tls::ClientTls;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The config that is used without `--config`.
const DEFAULT: &str = include_str!("../../../../deploy/ratn.toml");
const DEFAULT_NAME: &str = "the built-in config";
/// Placeholder for the system's speed in the arguments of a template.
const SPEED_PLACEHOLDER: &str = "{speed}";
/// The kind whose pool `--planners` sizes.
const PATH_PLANNER: &str = "PathPlanner";
/// Placeholder for the system's robot in the arguments of a template.
const ROBOT_PLACEHOLDER: &str = "{robot}";
/// What a cell provides once, in addition to the modules of its robot.
const BATTERY: &str = "Battery";
const SPEEDS: std::ops::RangeInclusive<f64> = 0.01..=1000.0;

/// All keys are optional.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, rename_all = "kebab-case")]
pub(crate) struct SystemConfig {
    /// Robot's seconds per second, for all roles.
    pub(crate) speed: f64,
    /// The robot, for all roles: the name of a built-in one, or the path of a `robot.toml`, relative to the folder of the config.
    pub(crate) robot: String,
    /// Settings shared by all daemons.
    pub(crate) service: ServiceConfig,
    pub(crate) resource_manager: ResourceManagerConfig,
    pub(crate) world_pool: WorldPoolConfig,
    pub(crate) process_manager: ProcessManagerConfig,
    pub(crate) cell: CellConfig,
    /// The parts of the catalogue: `built-in`, and files relative to the folder of this one. `catalogue` overrides them.
    pub(crate) catalogues: Vec<String>,
    /// The catalogue that tasks are checked against.
    pub(crate) catalogue: Catalogue,
    /// The parts of the robot.
    #[serde(skip)]
    parts: Parts,
}

impl Default for SystemConfig {
    fn default() -> Self {
        SystemConfig {
            speed: 1.0,
            robot: AIMM.to_owned(),
            service: ServiceConfig::default(),
            resource_manager: ResourceManagerConfig::default(),
            world_pool: WorldPoolConfig::default(),
            process_manager: ProcessManagerConfig::default(),
            cell: CellConfig::default(),
            catalogues: Vec::new(),
            catalogue: Catalogue::standard(),
            parts: Parts::default(),
        }
    }
}

/// The parts of a robot that matter for a cell.
#[derive(Debug, Clone, PartialEq)]
struct Parts {
    modules: Vec<Module>,
    joints: ArmJoints,
    /// The names of these joints.
    chain: Option<JointChain>,
    /// The attributes of the modules of each kind, in order: the cell's host, and for a robot with several arms the arm.
    attributes: ModuleAttributes,
    /// Whether it has a workplace: then the simulated cell has its modules, else drivers offer them.
    workplace: bool,
    /// Whether its workplace has a middle, which several arms reach.
    middle: bool,
}

/// For each kind of module, the attributes of each module.
type ModuleAttributes = BTreeMap<String, Vec<BTreeMap<String, Value>>>;

/// The number of joints of the robot's arm.
#[derive(Debug, Clone, Copy, PartialEq)]
enum ArmJoints {
    /// As in the catalogue.
    AsSaid,
    /// This number.
    Count(u32),
    /// Different arms have different numbers: the number in a goal is not checked.
    Various,
}

impl Default for Parts {
    fn default() -> Self {
        Parts {
            modules: Module::ALL.to_vec(),
            joints: ArmJoints::AsSaid,
            chain: None,
            attributes: ModuleAttributes::new(),
            workplace: true,
            middle: false,
        }
    }
}

impl Parts {
    /// Removes what the robot does not have, unless a template or a user-defined provider offers it, and sets the arm's number of joints.
    /// User-defined providers are unchanged.
    fn fit(&self, catalogue: &mut Catalogue, templates: &[Template]) {
        let standard = Catalogue::standard();
        let lacks = |kind: &str| {
            kind == MIDDLE && !self.middle
                || Module::ALL.iter().any(|module| module.kind() == kind && !self.modules.contains(module))
        };
        let started = |kind: &str| templates.iter().any(|template| template.kind == kind);
        catalogue.providers.retain(|name, provider| {
            !lacks(&provider.resource) || started(&provider.resource) || !standard.providers.contains_key(name)
        });
        let Catalogue { providers, resources, .. } = catalogue;
        let provided = |kind: &str| providers.values().any(|provider| provider.resource == kind);
        resources.retain(|kind, _| !lacks(kind) || started(kind) || provided(kind));
        for (kind, offer) in resources.iter_mut().filter(|(kind, offer)| standard.resources.get(*kind) == Some(offer)) {
            let many = self.modules.iter().filter(|module| module.kind() == kind).count() as u32;
            if many > 1 && !started(kind) {
                offer.count = many.into();
            }
        }
        let of_the_robot = providers.iter_mut().filter(|(name, _)| standard.providers.contains_key(*name));
        for (_, provider) in of_the_robot.filter(|(_, provider)| provider.joints.is_some()) {
            provider.joints = match self.joints {
                ArmJoints::AsSaid => provider.joints,
                ArmJoints::Count(count) => Some(count),
                ArmJoints::Various => None,
            };
            let has = |chain: &&JointChain| u32::try_from(chain.joints.len()).ok() == provider.joints;
            provider.chain = self.chain.as_ref().filter(has).cloned();
        }
    }
}

impl SystemConfig {
    /// Reads and checks a config, or the built-in one; an invalid one is refused.
    pub(crate) fn load(file: Option<&Path>) -> Result<SystemConfig, Failure> {
        SystemConfig::load_for(file, None)
    }

    /// As [`SystemConfig::load`], with the robot named on the command line.
    pub(crate) fn load_for(file: Option<&Path>, robot: Option<&str>) -> Result<SystemConfig, Failure> {
        let parsed = match file {
            None => SystemConfig::parse(DEFAULT, DEFAULT_NAME, Path::new(""), robot),
            Some(file) => SystemConfig::read_for(file, robot),
        };
        parsed.map_err(|error| Failure::Refused(format!("ratn: {error:#}")))
    }

    /// The listen address of each daemon, by role.
    pub(crate) fn listens(&self) -> [(&'static str, &Endpoint); 4] {
        [
            (resource_manager::ROLE, &self.resource_manager.listen),
            (world_pool::ROLE, &self.world_pool.listen),
            (ratn_cell::ROLE, &self.cell.listen),
            (process_manager::ROLE, &self.process_manager.listen),
        ]
    }

    /// Reads and checks a config.
    pub(crate) fn read(file: &Path) -> anyhow::Result<SystemConfig> {
        SystemConfig::read_for(file, None)
    }

    fn read_for(file: &Path, robot: Option<&str>) -> anyhow::Result<SystemConfig> {
        let name = file.display().to_string();
        let text = input::read(file).with_context(|| format!("cannot read the config {name}"))?;
        SystemConfig::parse(&text, &name, file.parent().unwrap_or(Path::new("")), robot)
    }

    /// `folder` is the config's folder; `robot` overrides the config's robot.
    fn parse(text: &str, name: &str, folder: &Path, robot: Option<&str>) -> anyhow::Result<SystemConfig> {
        let mut config: SystemConfig =
            toml::from_str(text).map_err(|error| anyhow::anyhow!("{name}: {}", error.to_string().trim_end()))?;
        config.check().with_context(|| name.to_owned())?;
        config.compose(folder).with_context(|| name.to_owned())?;
        config.process_manager.templates.iter_mut().for_each(|template| template.settle(folder));
        config.robot = match robot {
            Some(robot) => absolute(robot, Path::new(""))?,
            None => absolute(&config.robot, folder).with_context(|| name.to_owned())?,
        };
        config.catalogue.kinds.clone_from(&config.resource_manager.kinds);
        let fitted = config.fit_robot();
        if robot.is_some() {
            fitted.context("--robot")?
        } else {
            fitted.with_context(|| format!("{name}: `robot`"))?
        }
        config.settle();
        Ok(config)
    }

    fn check(&self) -> anyhow::Result<()> {
        anyhow::ensure!(SPEEDS.contains(&self.speed), "`speed` is {}: it must be 0.01 to 1000", self.speed);
        let of_its_own = CellConfig::default().speed;
        anyhow::ensure!(
            self.cell.speed == of_its_own || self.cell.speed == self.speed,
            "`cell.speed` is {} and `speed` is {}: a system has one speed, give it at the top",
            self.cell.speed,
            self.speed
        );
        let elsewhere = self.cell.robot != AIMM && self.cell.robot != self.robot;
        anyhow::ensure!(
            !elsewhere,
            "`cell.robot` is `{}` and `robot` is `{}`: a system has one robot, give it at the top",
            self.cell.robot,
            self.robot
        );
        self.service.check().context("[service]")?;
        self.resource_manager.check().context("[resource-manager]")?;
        self.world_pool.check().context("[world-pool]")?;
        self.process_manager.check().context("[process-manager]")?;
        self.cell.check().context("[cell]")
    }

    /// Composes the catalogue. Workers of the built-in catalogue that no template of this config starts are removed, unless the config's own
    /// catalogue section declares them.
    fn compose(&mut self, folder: &Path) -> anyhow::Result<()> {
        if self.catalogues.is_empty() {
            return Ok(());
        }
        let names = std::mem::take(&mut self.catalogues);
        let (mut composed, built_in) = catalogue::compose(&names, folder).context("`catalogues`")?;
        let own = std::mem::take(&mut self.catalogue);
        // If the file has no catalogue section, it is the built-in one.
        let mut declared = BTreeSet::new();
        if own != Catalogue::standard() {
            declared.extend(own.resources.keys().cloned());
            catalogue::extend(&mut composed, own);
        }
        let starts = |kind: &String| self.process_manager.templates.iter().any(|template| template.kind == *kind);
        let is_absent = |kind: &String| built_in.contains(kind) && !declared.contains(kind) && !starts(kind);
        composed.resources.retain(|kind, offer| offer.class != ResourceClass::Process || !is_absent(kind));
        self.catalogue = composed;
        Ok(())
    }

    /// Applies the robot: parts that it does not have are not offered, and the arm's number of joints is set.
    fn fit_robot(&mut self) -> anyhow::Result<()> {
        self.cell.robot.clone_from(&self.robot);
        // The built-in config has everything that the standard robot has, except its joints.
        if self.robot == AIMM {
            self.parts.chain = Robot::built_in(AIMM).as_ref().map(chain_of);
        } else {
            let robot = Robot::named_or_file(&self.robot).map_err(|error| match error {
                DescriptionError::Read { .. } if !Path::new(&self.robot).exists() => {
                    let known: Vec<&str> = Robot::built_in_names().collect();
                    anyhow::anyhow!("{} is no file, and no built-in robot: those are {}", self.robot, known.join(", "))
                }
                error => error.into(),
            })?;
            let counts: BTreeSet<usize> =
                robot.arm_names().enumerate().map(|(arm, _)| robot.joints_of(arm).len()).collect();
            let joints = match counts.first() {
                Some(count) if counts.len() == 1 => ArmJoints::Count(u32::try_from(*count)?),
                _ => ArmJoints::Various,
            };
            // With several arms it is unknown here which one a goal is for.
            let chain = robot.other_arms().next().is_none().then(|| chain_of(&robot));
            let modules = Module::of(&robot);
            let mut attributes = ModuleAttributes::new();
            for module in &modules {
                let arm = module.arm_name(&robot).map(|arm| ("arm", arm));
                let said = [("host", self.cell.host.as_str())].into_iter().chain(arm);
                let said = said.map(|(name, value)| (name.to_owned(), Value::String(value.to_owned())));
                attributes.entry(module.kind().to_owned()).or_default().push(said.collect());
            }
            let workplace = robot.workplace().is_some();
            let middle = robot.workplace().is_some_and(|workplace| workplace.middle.is_some());
            self.parts = Parts { modules, joints, chain, attributes, workplace, middle };
        }
        self.catalogue.check().context("`catalogue`")?;
        self.parts.fit(&mut self.catalogue, &self.process_manager.templates);
        self.process_manager_config().templates.iter().try_for_each(|template| self.check_told(template))
    }

    /// Checks that a bundled worker gets the system's robot. `{robot}` is substituted.
    fn check_told(&self, template: &Template) -> anyhow::Result<()> {
        let Template { name, args, .. } = template;
        if is_other_program(template) || !args.iter().any(|argument| argument == "worker") {
            return Ok(());
        }
        let said = "\"--robot\", \"{robot}\"";
        match told(args) {
            None if self.robot == AIMM => Ok(()),
            None => anyhow::bail!(
                "the template `{name}` does not say for which robot its worker is: add {said} to its args"
            ),
            Some(robot) if is_same(robot, &self.robot) => Ok(()),
            Some(robot) => anyhow::bail!(
                "the worker of the template `{name}` is for `{robot}`, the system for `{}`: a system has one robot; write {said} in its args",
                self.robot
            ),
        }
    }

    /// Derives dependent settings: the same speed everywhere, and as many workers in the catalogue as the templates can provide. A kind that
    /// no template provides stays in a user-defined catalogue, because another host may provide it; it is removed from the built-in one.
    fn settle(&mut self) {
        self.cell.speed = self.speed;
        let mut standard = Catalogue::standard();
        self.parts.fit(&mut standard, &self.process_manager.templates);
        let built_in = self.catalogue == standard;
        let templates = &self.process_manager.templates;
        self.catalogue.resources.retain(|kind, offer| {
            let provided: u32 = templates.iter().filter(|t| t.kind == *kind).map(|t| t.max_workers()).sum();
            if provided > 0 {
                offer.count = provided.into();
            }
            provided > 0 || offer.class != ResourceClass::Process || !built_in
        });
    }

    /// The TLS settings of clients of this system: from the environment, else from `[service.tls]`.
    pub(crate) fn client_tls(&self, from_environment: &ClientTls) -> Result<ClientTls, Failure> {
        let read = self.service.client_tls(from_environment).context("[service.tls]");
        read.map_err(|error| {
            Failure::Refused(format!("ratn: {error:#}; $RATN_TLS_CA names another authority to trust"))
        })
    }

    /// Applies the command line.
    pub(crate) fn apply(&mut self, arguments: &SystemArguments) {
        self.speed = arguments.speed.unwrap_or(self.speed);
        self.cell.scene = arguments.scene.unwrap_or(self.cell.scene);
        self.cell.boxes = arguments.goods.boxes.map_or(self.cell.boxes, |n| n as usize);
        self.cell.bowls = arguments.goods.bowls.map_or(self.cell.bowls, |n| n as usize);
        self.cell.forks = arguments.goods.forks.map_or(self.cell.forks, |n| n as usize);
        self.cell.cups = arguments.goods.cups.map_or(self.cell.cups, |n| n as usize);
        self.cell.plates = arguments.goods.plates.map_or(self.cell.plates, |n| n as usize);
        self.cell.seed = arguments.seed.unwrap_or(self.cell.seed);
        self.cell.faults.extend(&arguments.faults.fault);
        if let Some(planners) = arguments.planners {
            for template in self.process_manager.templates.iter_mut().filter(|t| t.kind == PATH_PLANNER) {
                template.min = planners;
                template.max = Some(planners);
            }
        }
        self.settle();
    }

    /// The same config at another speed.
    pub(crate) fn at_speed(mut self, speed: f64) -> SystemConfig {
        self.speed = speed;
        self.settle();
        self
    }

    /// The process manager's section with speed and robot substituted.
    pub(crate) fn process_manager_config(&self) -> ProcessManagerConfig {
        let mut config = self.process_manager.clone();
        for argument in config.templates.iter_mut().flat_map(|t| &mut t.args) {
            *argument = argument.replace(SPEED_PLACEHOLDER, &self.speed.to_string());
            *argument = argument.replace(ROBOT_PLACEHOLDER, &self.robot);
        }
        config
    }

    /// Whether a system on one machine has the simulated cell: a robot without a workplace has drivers in its place.
    pub(crate) fn has_cell(&self) -> bool {
        self.parts.workplace
    }

    /// The amount of each kind that exists once the system is ready.
    pub(crate) fn promised_resources(&self) -> BTreeMap<String, Quantity> {
        let mut promised: BTreeMap<String, Quantity> = BTreeMap::new();
        let middle = self.parts.middle.then_some(MIDDLE);
        let of_the_cell = self.parts.modules.iter().map(|module| module.kind()).chain([BATTERY]).chain(middle);
        for kind in of_the_cell.filter(|_| self.has_cell()) {
            *promised.entry(kind.to_owned()).or_default() += Quantity::ONE;
        }
        promised.insert(self.world_pool.kind.clone(), self.world_pool.capacity.into());
        for template in &self.process_manager.templates {
            *promised.entry(template.kind.clone()).or_default() += template.min.into();
        }
        promised
    }

    /// Adds the kinds of templates that the catalogue leaves out to it, as their workers do where they run.
    pub(crate) fn offer_templates(&mut self) {
        for template in &self.process_manager.templates {
            let offer = || ResourceOffer::new(ResourceClass::Process, template.max_workers());
            self.catalogue.resources.entry(template.kind.clone()).or_insert_with(offer);
        }
    }

    /// The names of the templates whose workers are another program than `ratn`, and so may describe actions that the catalogue does not have.
    pub(crate) fn may_describe(&self) -> Vec<&str> {
        let others = self.process_manager.templates.iter().filter(|template| is_other_program(template));
        others.map(|template| template.name.as_str()).collect()
    }

    /// The kinds of resources that perform actions of the catalogue and that neither the cell nor a template offers, each with its providers.
    pub(crate) fn offered_by_nobody(&self) -> BTreeMap<&str, Vec<&str>> {
        let kinds = self.resource_manager.hierarchy();
        let promised = self.promised_resources();
        let templates = self.process_manager.templates.iter().map(|template| template.kind.as_str());
        let offered: BTreeSet<&str> = promised.keys().map(String::as_str).chain(templates).collect();
        let is_offered = |kind: &str| offered.iter().any(|one| kinds.is_a(one, kind));
        let mut nobody: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
        for (name, provider) in self.catalogue.providers.iter().filter(|(_, one)| !is_offered(&one.resource)) {
            nobody.entry(&provider.resource).or_default().push(name);
        }
        nobody
    }

    /// Whether resources of a kind are the robot's arms or grippers, and not a worker's.
    pub(crate) fn is_module_of_arm(&self, kind: &str) -> bool {
        let is_of_arm = |module: &Module| module.kind() == kind && module.arm().is_some();
        self.parts.modules.iter().any(is_of_arm)
            && self.process_manager.templates.iter().all(|template| template.kind != kind)
    }

    /// The host of each module of a kind, and its arm where the robot has several.
    pub(crate) fn module_attributes(&self) -> &ModuleAttributes {
        &self.parts.attributes
    }

    /// The config as TOML.
    pub(crate) fn to_toml(&self) -> anyhow::Result<String> {
        toml::to_string(self).context("cannot write the config")
    }
}

/// Whether the workers of a template are another program than `ratn`.
fn is_other_program(template: &Template) -> bool {
    let is_ratn = |program: &Path| program.file_name() == Some("ratn".as_ref());
    template.python.is_some() || !template.program.as_deref().is_none_or(is_ratn)
}

/// The joints of a robot's first arm.
fn chain_of(robot: &Robot) -> JointChain {
    let limits = |(joint, slides): (&Joint, &bool)| {
        let limits = if joint.endless { [f64::NEG_INFINITY, f64::INFINITY] } else { joint.limits() };
        (limits, if *slides { "m" } else { "rad" })
    };
    JointChain {
        robot: robot.name().to_owned(),
        arm: robot.arm_name().to_owned(),
        joints: robot.arm_joints().iter().map(|joint| joint.name.clone()).collect(),
        limits: robot.arm_joints().iter().zip(robot.arm_slides()).map(limits).collect(),
    }
}

/// The robot in a worker's arguments, as `--robot=NAME` or `--robot NAME`.
fn told(args: &[String]) -> Option<&str> {
    let after = |i: usize| args.get(i + 1).map(String::as_str);
    args.iter().enumerate().find_map(|(i, argument)| match argument.strip_prefix("--robot") {
        Some("") => after(i),
        Some(rest) => rest.strip_prefix('='),
        None => None,
    })
}

/// Whether both name the same robot: a built-in one by its name, any other by its file.
pub(crate) fn is_same(one: &str, other: &str) -> bool {
    let is_built_in = |robot: &str| Robot::built_in_names().any(|name| name == robot);
    let file = |robot: &str| Path::new(robot).canonicalize().ok();
    one == other || !is_built_in(one) && !is_built_in(other) && file(one).is_some() && file(one) == file(other)
}

/// A robot as processes in other folders find it: a built-in one by its name, any other by its absolute path.
fn absolute(robot: &str, folder: &Path) -> anyhow::Result<String> {
    anyhow::ensure!(!robot.is_empty(), "`robot` is empty: name a built-in robot, or the path of a robot.toml");
    if Robot::built_in_names().any(|name| name == robot) {
        return Ok(robot.to_owned());
    }
    let path = std::path::absolute(folder.join(robot)).with_context(|| format!("`robot` is {robot}"))?;
    path.to_str().map(str::to_owned).with_context(|| format!("`robot` is {}: it must be UTF-8", path.display()))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::arguments::GoodsArguments;
    use proptest::collection::vec;
    use proptest::prelude::*;

    fn parse(text: &str, name: &str) -> anyhow::Result<SystemConfig> {
        SystemConfig::parse(text, name, Path::new(""), None)
    }

    #[test]
    fn the_built_in_config_reads_back_as_written() {
        let config = SystemConfig::load(None).unwrap();
        assert_eq!(parse(&config.to_toml().unwrap(), "again").unwrap(), config);
        assert_eq!(config.catalogue.resources[PATH_PLANNER].count, 4);
        assert_eq!(config.promised_resources()[PATH_PLANNER], 2);
    }

    #[test]
    fn tasks_are_checked_with_the_hierarchy_of_kinds_that_the_resource_manager_has() {
        let config = parse("[resource-manager.kinds]\nSmallPen = [\"Pen\"]\n", "ratn.toml").unwrap();
        assert_eq!(config.resource_manager.kinds.len(), 1);
        assert_eq!(config.catalogue.kinds, config.resource_manager.kinds);
    }

    #[test]
    fn the_command_line_overrides_it() {
        let mut config = SystemConfig::load(None).unwrap();
        config.apply(&SystemArguments {
            goods: GoodsArguments { boxes: Some(5), ..GoodsArguments::default() },
            planners: Some(1),
            speed: Some(8.0),
            seed: Some(7),
            ..SystemArguments::default()
        });
        assert_eq!((config.cell.boxes, config.cell.seed, config.cell.speed), (5, 7, 8.0));
        assert_eq!(config.promised_resources()[PATH_PLANNER], 1);
        assert!(config.process_manager_config().templates[0].args.contains(&"8".to_owned()));
    }

    #[test]
    fn what_no_template_provides_is_not_offered() {
        let without = parse("[process-manager]\ntemplate = []", "x.toml").unwrap();
        assert!(!without.catalogue.resources.contains_key(PATH_PLANNER));
        assert!(without.catalogue.resources.contains_key("Arm"));
        let elsewhere = "[catalogue.resources]\nPathPlanner = { class = \"process\", count = 3 }";
        assert_eq!(parse(elsewhere, "x.toml").unwrap().catalogue.resources[PATH_PLANNER].count, 3);
    }

    #[test]
    fn a_robot_without_base_and_head_offers_neither() {
        let config = parse("robot = \"panda\"", "x.toml").unwrap();
        for kind in ["Base", "PanTilt"] {
            assert!(!config.catalogue.resources.contains_key(kind) && !config.promised_resources().contains_key(kind));
            assert!(config.catalogue.providers.values().all(|provider| provider.resource != kind));
        }
        assert!(config.catalogue.resources.contains_key("Gripper"));
        assert_eq!((config.promised_resources()["Arm"], config.cell.robot.as_str()), (Quantity::ONE, "panda"));
        assert_eq!(parse(&config.to_toml().unwrap(), "again").unwrap(), config);
        let six = parse("robot = \"ur5\"", "x.toml").unwrap();
        assert_eq!(six.catalogue.providers["arm"].joints, Some(6));
    }

    #[test]
    fn a_robot_without_a_workplace_has_no_cell_and_what_drivers_are_to_offer_is_named() {
        let place = tempfile::tempdir().unwrap();
        let at = |name: &str| place.path().join(name);
        let link = "<link name='foot'/><link name='tip'/>";
        let joint = "<joint name='turn' type='revolute'><parent link='foot'/><child link='tip'/><axis xyz='0 0 1'/>\
                     <limit lower='-1' upper='1' velocity='1' effort='1'/></joint>";
        std::fs::write(at("r.urdf"), format!("<robot name='r'>{link}{joint}</robot>")).unwrap();
        let toml = "name = 'bare'\nurdf = 'r.urdf'\n[arm]\njoints = ['turn']\ntool = 'tip'\n[postures]\nhome = [0]\n";
        std::fs::write(at("robot.toml"), toml).unwrap();
        let robot = format!("robot = {:?}\n", at("robot.toml"));
        let template = |kind: &str| {
            format!("[[process-manager.template]]\nname = \"w\"\nkind = \"{kind}\"\nprogram = \"/bin/true\"\n")
        };
        let of = |more: &str| parse(&format!("{robot}{more}"), "x.toml").unwrap();
        let bare = of("");
        assert!(!bare.has_cell() && !bare.promised_resources().contains_key("Arm"));
        assert_eq!(bare.offered_by_nobody()["Arm"], ["arm"]);
        // This config has no template at all.
        assert!(bare.offered_by_nobody().contains_key(PATH_PLANNER));
        assert!(!of(&template(PATH_PLANNER)).offered_by_nobody().contains_key(PATH_PLANNER));
        assert!(!of(&template("Arm")).offered_by_nobody().contains_key("Arm"));
        let below = "[resource-manager.kinds]\nShortArm = [\"Arm\"]\n";
        assert!(!of(&(template("ShortArm") + below)).offered_by_nobody().contains_key("Arm"));
        let own = SystemConfig::load(None).unwrap();
        assert!(own.has_cell() && own.offered_by_nobody().is_empty(), "{:?}", own.offered_by_nobody());
    }

    #[test]
    fn joints_of_the_wrong_number_are_refused_with_the_robot_and_its_joints() {
        let refusal = |config: &str, joints: &str| {
            let config =
                if config.is_empty() { SystemConfig::load(None).unwrap() } else { parse(config, "x.toml").unwrap() };
            let task = format!(
                "task: t\nstates:\n  - go: {{ action: arm/move_to, in: {{ joints: \"{joints}\" }}, resources: [Arm] }}\n"
            );
            let findings = ratn_model::load::load(&task, "t.yaml", &config.catalogue).unwrap_err();
            findings.iter().map(|finding| finding.message.clone()).collect::<Vec<_>>()
        };
        let six = refusal("robot = \"ur5\"", "joints(0, 0, 0, 0, 0, 0, 0)").remove(0);
        let words = "the arm `arm` of the robot `ur5` has 6 joints (";
        assert!(six.contains(words) && six.ends_with("), and these are the positions of 7"), "{six}");
        let seven = refusal("", "joints(0, 0, 0)").remove(0);
        assert!(seven.contains("of the robot `aimm` has 7 joints (arm_joint_1, "), "{seven}");
        for (robot, beyond) in [("", "joints(9, 0, 0, 0, 0, 0, 0)"), ("robot = \"ur5\"", "joints(9, 0, 0, 0, 0, 0)")] {
            let limits = refusal(robot, beyond).remove(0);
            assert!(limits.contains(" cannot be at 9 rad: its limits are -"), "{limits}");
        }
    }

    #[test]
    fn a_worker_for_another_robot_than_that_of_the_system_is_refused() {
        let with = |robot: &str, args: &str| {
            let template = "name = \"path-planner\"\nkind = \"PathPlanner\"";
            parse(&format!("robot = \"{robot}\"\n[[process-manager.template]]\n{template}\n{args}\n"), "x.toml")
        };
        let worker = |more: &str| format!("args = [\"worker\", \"path-planner\"{more}]");
        for (robot, args) in [
            ("panda", worker(", \"--robot\", \"{robot}\"")),
            ("panda", worker(", \"--robot={robot}\"")),
            ("panda", worker(", \"--robot=panda\"")),
            ("aimm", worker("")),
            ("panda", "program = \"/opt/mine\"\nargs = [\"worker\"]".to_owned()),
        ] {
            assert!(with(robot, &args).is_ok(), "{args}: {:#}", with(robot, &args).unwrap_err());
        }
        for (robot, args, other) in [
            ("panda", worker(", \"--robot\", \"aimm\""), "`aimm`"),
            ("aimm", worker(", \"--robot\", \"panda\""), "`panda`"),
            ("panda", worker(", \"--robot=ur5\""), "`ur5`"),
            ("panda", worker(""), "does not say for which robot"),
            ("panda", format!("program = \"/usr/bin/ratn\"\n{}", worker("")), "does not say for which robot"),
        ] {
            let refused = format!("{:#}", with(robot, &args).unwrap_err());
            let parts = ["x.toml: `robot`", "`path-planner`", "{robot}", other];
            assert!(parts.iter().all(|part| refused.contains(part)), "{args}: {refused}");
        }
    }

    #[test]
    fn what_a_config_offers_itself_stays_whatever_the_robot_has() {
        let own = "catalogues = [\"built-in\"]\n[catalogue.resources.PathPlanner]\nclass = \"process\"\ncount = 3\n\
            [process-manager]\ntemplate = []\n";
        assert_eq!(parse(own, "x.toml").unwrap().catalogue.resources[PATH_PLANNER].count, 3);
        let hand = "robot = \"ur5\"\ncatalogues = [\"built-in\"]\n[catalogue.resources.Hand]\nclass = \"module\"\ncount = 1\n\
            [catalogue.providers.left_hand]\nresource = \"Hand\"\njoints = 16\n";
        let hand = parse(hand, "x.toml").unwrap().catalogue;
        assert_eq!((hand.providers["left_hand"].joints, hand.providers["arm"].joints), (Some(16), Some(6)));
        let head =
            "robot = \"panda\"\ncatalogues = [\"built-in\"]\n[catalogue.providers.mast]\nresource = \"PanTilt\"\n";
        let head = parse(head, "x.toml").unwrap();
        assert!(head.catalogue.resources.contains_key("PanTilt") && head.catalogue.providers.contains_key("mast"));
        assert!(!head.catalogue.providers.contains_key("pan_tilt") && !head.catalogue.resources.contains_key("Base"));
        assert!(!head.promised_resources().contains_key("PanTilt"));
    }

    #[test]
    fn a_robot_that_nobody_knows_is_refused_with_those_that_are_known() {
        let refused = format!("{:#}", parse("robot = \"pandaa\"", "x.toml").unwrap_err());
        assert!(refused.starts_with("x.toml: `robot`") && refused.contains("aimm, panda, ur5"), "{refused}");
        let two = format!("{:#}", parse("robot = \"ur5\"\ncell.robot = \"panda\"", "x.toml").unwrap_err());
        assert!(two.contains("a system has one robot"), "{two}");
    }

    #[test]
    fn a_catalogue_is_made_of_the_built_in_one_files_and_its_own_section() {
        let folder = tempfile::tempdir().unwrap();
        let of_file = "[resources.Inspector]\nclass = \"process\"\ncount = 3\n";
        std::fs::write(folder.path().join("inspector.toml"), of_file).unwrap();
        let text = "catalogues = [\"built-in\", \"inspector.toml\"]\n[catalogue.providers.inspector]\nresource = \"Inspector\"\n\
            [process-manager]\ntemplate = []\n";
        let file = folder.path().join("system.toml");
        std::fs::write(&file, text).unwrap();
        let config = SystemConfig::read(&file).unwrap();
        let catalogue = &config.catalogue;
        assert_eq!(catalogue.resources["Inspector"].count, 3);
        assert!(catalogue.providers.contains_key("inspector") && catalogue.providers.contains_key("arm"));
        assert!(catalogue.resources.contains_key("Arm") && !catalogue.resources.contains_key(PATH_PLANNER));
        // The written config needs no other file.
        assert_eq!(parse(&config.to_toml().unwrap(), "elsewhere.toml").unwrap(), config);
        let refused = format!("{:#}", parse("catalogues = [\"no.toml\"]", "x.toml").unwrap_err());
        assert!(refused.starts_with("x.toml: `catalogues`: cannot read the catalogue no.toml"), "{refused}");
    }

    #[test]
    fn a_bad_config_is_refused_with_its_place() {
        let refusal = |text| parse(text, "x.toml").unwrap_err();
        assert!(format!("{:#}", refusal("sped = 2")).starts_with("x.toml: TOML parse error at line 1"));
        assert!(format!("{:#}", refusal("speed = 0")).contains("`speed` is 0: it must be 0.01 to 1000"));
        assert!(format!("{:#}", refusal("[cell]\nboxes = 10")).contains("x.toml: [cell]: `boxes`"));
        assert!(format!("{:#}", refusal("[world-pool]\ncapacity = 0")).contains("[world-pool]: `capacity`"));
    }

    /// Collects the path to every key with a value, with the built-in config as the example.
    fn keys(value: &toml::Value, way: &mut Vec<String>, all: &mut Vec<Vec<String>>) {
        match value {
            toml::Value::Table(table) => table.iter().for_each(|(key, value)| {
                way.push(key.clone());
                keys(value, way, all);
                way.pop();
            }),
            toml::Value::Array(values) if values.first().is_some_and(toml::Value::is_table) => {
                way.push("0".to_owned());
                keys(&values[0], way, all);
                way.pop();
            }
            _ => all.push(way.clone()),
        }
    }

    fn replaced(config: &toml::Value, way: &[String], value: toml::Value) -> String {
        let mut config = config.clone();
        let place = way.iter().fold(&mut config, |place, step| match place {
            toml::Value::Array(values) => &mut values[step.parse::<usize>().unwrap()],
            place => place.get_mut(step.as_str()).unwrap(),
        });
        *place = value;
        toml::to_string(&config).unwrap()
    }

    #[test]
    fn a_value_that_a_key_cannot_have_is_refused_with_the_key() {
        let config = toml::Value::try_from(SystemConfig::load(None).unwrap()).unwrap();
        let mut all = Vec::new();
        keys(&config, &mut Vec::new(), &mut all);
        assert!(all.len() > 60, "{all:?}");
        let date: toml::Value = "1979-05-27".parse::<toml::value::Datetime>().unwrap().into();
        let odd = [
            toml::Value::Integer(-1),
            toml::Value::Integer(i64::MAX),
            toml::Value::Float(f64::NAN),
            toml::Value::Float(-1e300),
            toml::Value::String("\u{7f}\u{0}".to_owned()),
            toml::Value::String(String::new()),
            toml::Value::Array(Vec::new()),
            toml::Value::Table(toml::Table::new()),
        ];
        for way in all {
            // A list of numbers is named by the list.
            let key = way.iter().rev().find(|step| step.parse::<usize>().is_err()).unwrap();
            // No key takes a date. A value of `odd` may be one that the key takes; otherwise the refusal names the key.
            let refused = parse(&replaced(&config, &way, date.clone()), "x.toml").unwrap_err();
            assert!(format!("{refused:#}").contains(key.as_str()), "{way:?}: {refused:#}");
            for value in &odd {
                if let Err(refused) = parse(&replaced(&config, &way, value.clone()), "x.toml") {
                    let said = format!("{refused:#}");
                    assert!(said.starts_with("x.toml") && said.contains(key.as_str()), "{way:?} = {value}: {said}");
                }
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(300))]

        #[test]
        fn a_config_that_was_changed_anywhere_is_taken_or_refused_with_its_file(
            changes in vec((any::<prop::sample::Index>(), any::<prop::sample::Index>(), ".{0,3}"), 1..6),
        ) {
            let mut text: Vec<char> = DEFAULT.chars().collect();
            for (from, length, instead) in changes {
                let from = from.index(text.len());
                let to = (from + length.index(12)).min(text.len());
                text.splice(from..to, instead.chars());
            }
            let text: String = text.into_iter().collect();
            if let Err(refused) = parse(&text, "x.toml") {
                prop_assert!(format!("{refused:#}").starts_with("x.toml: "), "{refused:#}");
            }
        }

        #[test]
        fn any_text_is_taken_or_refused_with_its_file(text in "\\PC{0,200}") {
            if let Err(refused) = parse(&text, "x.toml") {
                prop_assert!(format!("{refused:#}").starts_with("x.toml: "), "{refused:#}");
            }
        }
    }
}
