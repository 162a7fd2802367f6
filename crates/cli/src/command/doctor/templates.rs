//! Templates: whether their programs exist and may be started, and whether somebody offers what the actions of the catalogue need.

use super::Findings;
use crate::system::config::SystemConfig;

pub(super) fn check(findings: &mut Findings, config: &SystemConfig) {
    for (kind, providers) in config.offered_by_nobody() {
        findings.warning(
            format!("kind {kind}"),
            format!("nothing here offers a {kind}, which performs `{}`", providers.join("`, `")),
            "a run that needs one waits for it: add a template with this kind, or see that another host has one",
        );
    }
    for template in &config.process_manager.templates {
        let about = format!("template {}", template.name);
        match template.obstacle() {
            Some(obstacle) => findings.problem(
                about,
                obstacle,
                "if its workers run on another host, this is well there: `ratn doctor` on that host says so",
            ),
            None => match template.lacks_package() {
                Some(lacks) => findings.warning(
                    about,
                    lacks,
                    "install the package there, or name another `interpreter`; a worker that speaks the protocol without it needs none",
                ),
                None => findings.ok(about, template.interpreter().as_deref().unwrap_or("what it starts is there")),
            },
        }
    }
}
