//! What a robot looks like: visuals of its URDF, their meshes and colours, and what is not read of them.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_motion::geometry::Geometry;
use ratn_motion::looks::{Looks, MAX_MESH_FILES, MAX_VISUALS, VisualForm};
use ratn_motion::mesh::{Mesh, MeshError};
use ratn_motion::robot::Robot;

/// Two triangles, of the materials `red` and `blue` of the file; a third one of a material that is not there.
const TWO_COLOURS: &str = "<COLLADA><asset><unit meter='0.001'/></asset>
<library_effects>
 <effect id='red-effect'><profile_COMMON><technique sid='common'><phong><diffuse><color>1 0.25 0 1</color></diffuse></phong></technique></profile_COMMON></effect>
 <effect id='blue-effect'><profile_COMMON><technique sid='common'><lambert><diffuse><color>0 0 7 1</color></diffuse></lambert></technique></profile_COMMON></effect>
</library_effects>
<library_materials>
 <material id='red'><instance_effect url='#red-effect'/></material>
 <material id='blue'><instance_effect url='#blue-effect'/></material>
</library_materials>
<library_geometries><geometry id='g'><mesh>
 <source id='s'><float_array id='a' count='12'>0 0 0 100 0 0 0 100 0 0 0 100</float_array></source>
 <vertices id='v'><input semantic='POSITION' source='#s'/></vertices>
 <triangles material='m1' count='1'><input semantic='VERTEX' source='#v' offset='0'/><p>0 1 2</p></triangles>
 <triangles material='m2' count='1'><input semantic='VERTEX' source='#v' offset='0'/><p>0 1 3</p></triangles>
 <triangles material='m3' count='1'><input semantic='VERTEX' source='#v' offset='0'/><p>0 2 3</p></triangles>
 <triangles material='m1' count='1'><input semantic='VERTEX' source='#v' offset='0'/><p>1 2 3</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id='scene'><node><instance_geometry url='#g'><bind_material><technique_common>
 <instance_material symbol='m1' target='#red'/><instance_material symbol='m2' target='#blue'/><instance_material symbol='m3' target='#gone'/>
</technique_common></bind_material></instance_geometry></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url='#scene'/></scene></COLLADA>";

const OBJ: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";

fn looks(visuals: &str) -> Looks {
    let urdf = format!(
        "<robot name='r'><material name='grey'><color rgba='0.5 0.5 0.5 1'/></material><link name='l'>{visuals}</link></robot>"
    );
    Looks::read(&urdf, &mut |name| match name {
        "two.dae" => Ok(TWO_COLOURS.as_bytes().to_vec()),
        "one.obj" => Ok(OBJ.as_bytes().to_vec()),
        "torn.obj" => Ok(b"v 0 0\n".to_vec()),
        _ => Err(MeshError::Read { reason: "no file is there".to_owned() }),
    })
}

fn visual(geometry: &str, material: &str) -> String {
    format!("<visual><origin xyz='1 2 3'/><geometry>{geometry}</geometry>{material}</visual>")
}

#[test]
fn primitives_have_the_colours_of_their_materials_by_value_or_by_name() {
    let seen = looks(
        &[
            visual("<box size='1 2 3'/>", "<material name='own'><color rgba='0.1 0.2 0.3 1'/></material>"),
            visual("<sphere radius='0.5'/>", "<material name='grey'/>"),
            visual("<cylinder radius='0.5' length='2'/>", "<material name='own'/>"),
            visual("<box size='1 1 1'/>", "<material name='nobody'/>"),
            visual("<box size='1 1 1'/>", "<material name='loud'><color rgba='2 -1 nan 1'/></material>"),
        ]
        .concat(),
    );
    let colours: Vec<_> = seen.visuals.iter().map(|visual| visual.colour).collect();
    let own = Some([0.1, 0.2, 0.3]);
    assert_eq!(colours, [own, Some([0.5; 3]), own, None, Some([1.0, 0.0, 0.0])]);
    let VisualForm::Primitive(body) = &seen.visuals[0].form else { panic!("{:?}", seen.visuals[0]) };
    assert_eq!((body.geometry, body.upright().position), (Geometry::Box { half: [0.5, 1.0, 1.5] }, [1.0, 2.0, 3.0]));
    assert!(seen.lacks.is_empty() && seen.meshes.is_empty());
}

#[test]
fn a_mesh_has_the_colours_of_its_file_unless_the_urdf_says_one() {
    let mesh = |material| visual("<mesh filename='two.dae'/>", material);
    let seen = looks(&[mesh(""), mesh("<material name='grey'/>")].concat());
    let told: Vec<_> = seen
        .visuals
        .iter()
        .map(|visual| match visual.form {
            VisualForm::Mesh { mesh, pose } => (mesh, pose.position, visual.colour),
            VisualForm::Primitive(_) => panic!("{visual:?}"),
        })
        .collect();
    let at = [1.0, 2.0, 3.0];
    let (red, blue, grey) = (Some([1.0, 0.25, 0.0]), Some([0.0, 0.0, 1.0]), Some([0.5; 3]));
    assert_eq!(told[..3], [(0, at, red), (1, at, blue), (2, at, None)]);
    assert_eq!(told[3..], [(0, at, grey), (1, at, grey), (2, at, grey)], "the file is read once");
    let counts: Vec<usize> = seen.meshes.iter().map(|mesh| mesh.triangles().len()).collect();
    assert_eq!(counts, [2, 1, 1]);
    assert_eq!(seen.meshes[1].triangles()[0], [[0.0; 3], [0.1, 0.0, 0.0], [0.0, 0.0, 0.1]], "in metres");
    // Where it is a shape that can collide, its triangles stand as in the file.
    let whole = Mesh::read("two.dae", TWO_COLOURS.as_bytes(), [1.0; 3]).unwrap();
    assert_eq!(whole.triangles().len(), 4);
    assert_eq!(whole.triangles()[3][0], [0.1, 0.0, 0.0]);
}

#[test]
fn the_materials_of_an_obj_are_looked_for_beside_it_alone() {
    let faces = "f 1 2 3\nusemtl dark red\nf 1 2 4\nusemtl gone\nf 2 3 4\nusemtl dark red\nf 1 3 4\n";
    let obj = format!("mtllib ../../etc/colours.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n{faces}");
    let read = |materials: &str| {
        let mut asked = Vec::new();
        let urdf = format!(
            "<robot name='r'><link name='l'>{}</link></robot>",
            visual("<mesh filename='package://arm/meshes/four.obj'/>", "")
        );
        let seen = Looks::read(&urdf, &mut |name| {
            asked.push(name.to_owned());
            Ok(if name.ends_with(".obj") { obj.as_bytes().to_vec() } else { materials.as_bytes().to_vec() })
        });
        assert_eq!(asked, ["package://arm/meshes/four.obj", "package://arm/meshes/colours.mtl"]);
        let counts: Vec<usize> = seen.meshes.iter().map(|mesh| mesh.triangles().len()).collect();
        (counts, seen.visuals.iter().map(|visual| visual.colour).collect::<Vec<_>>())
    };
    let dark_red = Some([0.5, 0.0, 0.0]);
    assert_eq!(read("newmtl dark red # ish\nKa 1 1 1\nKd 0.5 0 0\n"), (vec![2, 2], vec![None, dark_red]));
    for broken in ["", "Kd 0.5 0 0", "newmtl dark red\nKd 0.5 0\n", "newmtl dark red\nKd red 0 0\n"] {
        assert_eq!(read(broken), (vec![4], vec![None]), "{broken}");
    }
}

#[test]
fn what_is_wrong_with_a_material_of_a_file_costs_its_colour_alone() {
    for broken in [
        TWO_COLOURS.replace("1 0.25 0 1", "red"),
        TWO_COLOURS.replace("url='#red-effect'", ""),
        TWO_COLOURS.replace("<phong>", "<phong><diffuse/></phong><phong>"),
    ] {
        let urdf =
            format!("<robot name='r'><link name='l'>{}</link></robot>", visual("<mesh filename='two.dae'/>", ""));
        let seen = Looks::read(&urdf, &mut |_| Ok(broken.as_bytes().to_vec()));
        assert_eq!((seen.lacks.len(), seen.meshes.len()), (0, 2));
        assert_eq!(seen.visuals.iter().map(|visual| visual.colour.is_some()).collect::<Vec<_>>(), [false, true]);
    }
}

#[test]
fn a_visual_that_cannot_be_read_is_named_and_the_others_are_there() {
    let file = |name: &str| visual(&format!("<mesh filename='{name}'/>"), "");
    let seen = looks(&[file("torn.obj"), file("gone.stl"), file("one.obj"), file("one.glb")].concat());
    assert_eq!((seen.visuals.len(), seen.meshes.len()), (1, 1));
    let lacks: Vec<String> = seen.lacks.iter().map(|lack| format!("{}: {}", lack.link, lack.reason)).collect();
    assert_eq!(
        lacks,
        [
            "l: the mesh `torn.obj`: line 1: a vertex `v` has three numbers",
            "l: the mesh `gone.stl`: cannot be read: no file is there",
            "l: the mesh `one.glb`: cannot be read: no file is there"
        ]
    );
    assert!(Looks::read("<robot>", &mut |_| Err(MeshError::Kind)).lacks[0].reason.contains("not valid URDF"));
    assert!(Looks::named_or_file("/nowhere/robot.toml").lacks[0].reason.contains("/nowhere/robot.toml"));
}

#[test]
fn visuals_and_files_have_a_bound() {
    let many: String = (0..=MAX_VISUALS).map(|_| visual("<sphere radius='1'/>", "")).collect();
    let seen = looks(&many);
    assert_eq!((seen.visuals.len(), seen.lacks.len()), (MAX_VISUALS, 1));
    let files: String = (0..=MAX_MESH_FILES).map(|n| visual(&format!("<mesh filename='{n}.obj'/>"), "")).collect();
    let mut read = 0;
    let urdf = format!("<robot name='r'><link name='l'>{files}</link></robot>");
    let seen = Looks::read(&urdf, &mut |_| {
        read += 1;
        Ok(OBJ.as_bytes().to_vec())
    });
    assert_eq!((read, seen.meshes.len(), seen.lacks.len()), (MAX_MESH_FILES, MAX_MESH_FILES, 1));
}

#[test]
fn the_robots_that_we_ship_have_no_visuals_and_lack_nothing() {
    for name in Robot::built_in_names() {
        let seen = Looks::named_or_file(name);
        assert!(seen.visuals.is_empty() && seen.lacks.is_empty(), "{name}");
    }
}
