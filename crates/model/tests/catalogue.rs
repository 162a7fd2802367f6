//! The catalogue: what a worker may say of itself, and where the two differ.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod said {
    use ratn_model::catalogue::{ActionSignature, Catalogue, WorkerDescription};
    use ratn_model::value::Type;
    use std::collections::BTreeMap;

    fn described(signature: ActionSignature) -> WorkerDescription {
        let actions = [("read".to_owned(), Some(signature))].into();
        WorkerDescription { provider: "labels".to_owned(), kind: "LabelReader".to_owned(), actions }
    }

    #[test]
    fn what_a_worker_says_beyond_the_bounds_is_refused_by_name() {
        let ports = |count| (0..count).map(|n| (format!("p{n}"), Type::Any)).collect::<BTreeMap<_, _>>();
        let refused = |signature| described(signature).check().unwrap_err().to_string();
        let many = refused(ActionSignature { inputs: ports(100), outputs: ports(29), ..ActionSignature::default() });
        assert_eq!(many, "it says 129 ports, outcomes and annotations of action `read`: at most 128 are taken");
        let odd =
            refused(ActionSignature { outputs: [("a\nb".to_owned(), Type::Any)].into(), ..ActionSignature::default() });
        assert!(odd.contains("its port `a?b` of action `read` is no name"), "{odd}");
        let long = refused(ActionSignature { description: "x".repeat(3_000), ..ActionSignature::default() });
        assert!(long.contains("its description of action `read` is too long"), "{long}");
        let twice = ActionSignature { inputs: ports(1), optional: ports(1), ..ActionSignature::default() };
        assert!(refused(twice).contains("`p0` twice"));
        let actions = (0..129).map(|n| (format!("a{n}"), None)).collect();
        let crowd = WorkerDescription { actions, ..WorkerDescription::default() };
        assert!(crowd.check().unwrap_err().to_string().starts_with("it says 129 actions"));
        let defaulted = |of: Type, default: &str| ActionSignature {
            optional: [("n".to_owned(), of)].into(),
            defaults: [("n".to_owned(), default.to_owned())].into(),
            ..ActionSignature::default()
        };
        for (of, default) in [(Type::Int, "fast"), (Type::Int, "2.5"), (Type::Joints, "[1, 2]"), (Type::Pose, "-3")] {
            let words = format!("action `read`: the default of port `n` is `{default}`, which is no {of}");
            assert_eq!(refused(defaulted(of, default)), words);
        }
        for (of, default) in [
            (Type::Float, "3"),
            (Type::String, "3"),
            (Type::Int, "null"),
            (Type::Joints, "joints(0.1, -0.2)"),
            (Type::List(Box::new(Type::Float)), "[0.36, -1]"),
            (Type::Pose, "pose(1.000, 0.000, 0.700; 0.000, 0.000, 0.000, 1.000)"),
            // Nobody computes what somebody else wrote.
            (Type::Int, "repeat(repeat(1, 1000000), 1000000)"),
        ] {
            assert_eq!(described(defaulted(of, default)).check(), Ok(()));
        }
        assert_eq!(described(ActionSignature { inputs: ports(128), ..ActionSignature::default() }).check(), Ok(()));
    }

    #[test]
    fn an_action_has_a_name_of_any_language_that_a_task_can_write() {
        let called = |name: &str| {
            let actions = [(name.to_owned(), None)].into();
            WorkerDescription { actions, ..WorkerDescription::default() }.check().map_err(|error| error.to_string())
        };
        for name in ["3d_scan", "_private", "scan.v2", "scan-twice"] {
            assert_eq!(called(name), Ok(()));
        }
        for name in ["", "-x", ".x", "a/b", "a b", "größe", "a\u{1b}[2J"] {
            assert!(called(name).unwrap_err().contains("the first one a letter, a digit or `_`"), "{name}");
        }
    }

    #[test]
    fn the_catalogue_is_extended_by_what_a_worker_says_and_never_overridden() {
        let of_type =
            |of: Type| ActionSignature { outputs: [("text".to_owned(), of)].into(), ..ActionSignature::default() };
        let mut catalogue = Catalogue::standard();
        catalogue.extend_by("LabelReader", 2.into(), &described(of_type(Type::String)));
        assert_eq!(catalogue.action("labels", "read").unwrap().outputs["text"], Type::String);
        assert_eq!(catalogue.resources["LabelReader"].count, 2);
        let before = catalogue.clone();
        catalogue.extend_by("LabelReader", 9.into(), &described(of_type(Type::Int)));
        catalogue.extend_by("Other", 9.into(), &described(of_type(Type::Int)));
        assert_eq!(catalogue, before);
    }
}

mod compared {
    use ratn_model::catalogue::{ActionSignature, Catalogue, WorkerDescription};

    const CATALOGUE: &str = "[resources.LabelReader]\nclass = \"process\"\ncount = 1\n[providers.labels]\nresource = \"LabelReader\"\n\
        [providers.labels.actions.read]\ninputs = { at = \"pose\" }\noptional = { tries = \"int\" }\noutputs = { text = \"string\" }\n";

    fn said(provider: &str, kind: &str, action: &str, signature: &str) -> WorkerDescription {
        let signature = (!signature.is_empty()).then(|| toml::from_str(signature).unwrap());
        let actions = [(action.to_owned(), signature)].into();
        WorkerDescription { provider: provider.to_owned(), kind: kind.to_owned(), actions }
    }

    fn found(worker: &WorkerDescription, kind: &str) -> Vec<String> {
        worker.mismatches(&Catalogue::from_toml(CATALOGUE).unwrap(), kind)
    }

    #[test]
    fn a_worker_that_is_as_the_catalogue_says_or_says_nothing_has_no_mismatch() {
        let same = "inputs = { at = \"pose\" }\noptional = { tries = \"float\" }\noutputs = { text = \"string\", extra = \"int\" }";
        let none: [&str; 0] = [];
        assert_eq!(found(&said("labels", "LabelReader", "read", same), "LabelReader"), none);
        assert_eq!(found(&said("", "", "read", ""), "LabelReader"), none, "one that does not describe itself");
        assert_eq!(
            found(&said("inspector", "Inspector", "look", "outputs = { n = \"int\" }"), "Inspector"),
            none,
            "a new one"
        );
    }

    #[test]
    fn every_difference_is_told() {
        let other =
            "inputs = { at = \"joints\", from = \"pose\" }\noutputs = { text = \"int\" }\noutcomes = [\"unreadable\"]";
        assert_eq!(
            found(&said("labels", "LabelReader", "read", other), "LabelReader"),
            [
                "`labels/read`: input `at` is pose in the catalogue, and the worker takes joints",
                "`labels/read`: the catalogue has an input `tries`, which the worker does not take",
                "`labels/read`: the worker needs an input `from`, which is not there in the catalogue",
                "`labels/read`: output `text` is string in the catalogue, and the worker writes int",
                "`labels/read`: the worker may end with `unreadable`, which is not among the outcomes of the catalogue",
            ]
        );
        assert_eq!(
            found(&said("", "", "raed", ""), "LabelReader"),
            ["the catalogue has `labels/read`, and the worker performs raed"]
        );
    }

    #[test]
    fn a_kind_that_nobody_who_waits_for_the_worker_asks_for_is_told() {
        let read = "inputs = { at = \"pose\" }\noptional = { tries = \"int\" }\noutputs = { text = \"string\" }";
        let kinds = found(&said("labels", "LabelReader", "read", read), "Labels");
        assert!(kinds[0].contains("`LabelReader`, and its template that it is a `Labels`"), "{kinds:?}");
        assert!(kinds[1].contains("a state that blocks a `LabelReader` does not get it"), "{kinds:?}");
        let name = found(&said("label", "LabelReader", "read", read), "LabelReader");
        assert!(
            name[0].contains("calls itself `label`, and the catalogue what is a `LabelReader` `labels`"),
            "{name:?}"
        );
    }

    #[test]
    fn of_hundreds_of_mismatches_the_first_are_told() {
        let outputs = (0..200).map(|n| format!("o{n} = \"int\"")).collect::<Vec<_>>().join(", ");
        let mut catalogue = Catalogue::from_toml(CATALOGUE).unwrap();
        let many: ActionSignature = toml::from_str(&format!("outputs = {{ {outputs} }}")).unwrap();
        catalogue.providers.get_mut("labels").unwrap().actions.insert("read".to_owned(), many);
        let found = said("labels", "", "read", "description = \"x\"").mismatches(&catalogue, "LabelReader");
        assert_eq!((found.len(), found[15].as_str()), (16, "and 185 more"));
    }
}
