// VAMP's RRT-Connect and simplification on the problems of a text file of problems.py, a line per problem as `--example search` prints it:
//
//     vamp ROBOT PROBLEMS.txt [REPEAT [SAMPLES [SKIP [PATHS]]]]
//
// SKIP samples of its Halton sequence are left out, for another sequence. PATHS is a file for the paths that were found, for `--example judge`. Compile with VAMP's options (cmake/CompilerSettings.cmake) and its
// headers, nigh's, pdqsort's and Eigen's; with its clock, `std::chrono::steady_clock` in rrtc.hh, simplify.hh and utils.hh, replaced by one that
// reads CLOCK_THREAD_CPUTIME_ID, the times are processor time.
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <string>
#include <vamp/collision/factory.hh>
#include <vamp/planning/rrtc.hh>
#include <vamp/planning/simplify.hh>
#include <vamp/random/halton.hh>
#include <vamp/robots/baxter.hh>
#include <vamp/robots/fetch.hh>
#include <vamp/robots/panda.hh>
#include <vamp/robots/ur5.hh>

using namespace vamp;
static constexpr std::size_t rake = FloatVectorWidth;

// As VAMP's Python module makes it.
static collision::Environment<float> read(std::ifstream &in, int things)
{
    collision::Environment<float> environment;
    for (int i = 0; i < things; i++)
    {
        std::string kind;
        float p[3], r[3], a[3];
        in >> kind;
        for (float &x : p)
            in >> x;
        for (float &x : r)
            in >> x;
        if (kind == "box")
        {
            in >> a[0] >> a[1] >> a[2];
            auto box = collision::factory::cuboid::flat(p[0], p[1], p[2], r[0], r[1], r[2], a[0], a[1], a[2]);
            (box.axis_3_z == 1.F ? environment.z_aligned_cuboids : environment.cuboids).push_back(box);
        }
        else if (kind == "capsule")
        {
            in >> a[0] >> a[1];
            auto capsule = collision::factory::capsule::center::flat(p[0], p[1], p[2], r[0], r[1], r[2], a[0], a[1]);
            bool upright = capsule.xv == 0.F && capsule.yv == 0.F;
            (upright ? environment.z_aligned_capsules : environment.capsules).push_back(capsule);
        }
        else
        {
            in >> a[0];
            environment.spheres.push_back(collision::factory::sphere::flat(p[0], p[1], p[2], a[0]));
        }
    }
    environment.sort();
    return environment;
}

template <typename Robot>
static int run(const char *file, float range, int repeat, std::size_t samples, int skip, const char *paths)
{
    using RRTC = planning::RRTC<Robot, rake, Robot::resolution>;
    std::ifstream in(file);
    std::ofstream out(paths);
    out.precision(9);
    std::string name;
    int index, things;
    while (in >> name >> index >> things)
    {
        collision::Environment<FloatVector<rake>> environment(read(in, things));
        typename Robot::ConfigurationArray from, to;
        for (auto &x : from)
            in >> x;
        for (auto &x : to)
            in >> x;
        typename Robot::Configuration start(from), goal(to);
        auto is_free = [&](auto &q) { return planning::validate_motion<Robot, rake, 1>(q, q, environment); };
        if (!is_free(start) || !is_free(goal))
        {
            std::printf("%s %d invalid\n", name.c_str(), index);
            continue;
        }
        planning::RRTCSettings settings;
        settings.range = range;
        settings.max_iterations = settings.max_samples = samples;
        planning::SimplifySettings simplification;
        auto rng = std::make_shared<rng::Halton<Robot>>();
        double plan = 1e30, simplify = 1e30;
        float before = 0, after = 0;
        std::size_t drawn = 0;
        bool solved = true;
        for (int i = 0; i < repeat && solved; i++)
        {
            rng->reset();
            for (int s = 0; s < skip; s++)
                rng->next();
            auto found = RRTC::solve(start, goal, environment, settings, rng);
            plan = std::min(plan, found.nanoseconds / 1e3);
            drawn = found.iterations;
            solved = !found.path.empty();
            if (solved)
            {
                auto shorter = planning::simplify<Robot, rake, Robot::resolution>(found.path, environment, simplification, rng);
                simplify = std::min(simplify, shorter.nanoseconds / 1e3);
                before = found.path.cost();
                after = shorter.path.cost();
                if (i == 0)
                {
                    out << name << ' ' << index;
                    for (const auto &posture : shorter.path)
                        for (std::size_t j = 0; j < Robot::dimension; j++)
                            out << ' ' << posture.to_array()[j];
                    out << '\n';
                }
            }
        }
        if (solved)
            std::printf("%s %d solved %.3f %.3f %zu %.4f %.4f\n", name.c_str(), index, plan, simplify, drawn, before, after);
        else
            std::printf("%s %d failed %.3f 0 %zu\n", name.c_str(), index, plan, drawn);
    }
    return 0;
}

int main(int count, char **arguments)
{
    std::string robot = arguments[1];
    int repeat = count > 3 ? std::atoi(arguments[3]) : 1;
    std::size_t samples = count > 4 ? std::atol(arguments[4]) : 1000000;
    int skip = count > 5 ? std::atoi(arguments[5]) : 0;
    const char *paths = count > 6 ? arguments[6] : "/dev/null";
    // VAMP's own ranges (constants.py).
    if (robot == "panda")
        return run<robots::Panda>(arguments[2], 1.0F, repeat, samples, skip, paths);
    if (robot == "ur5")
        return run<robots::UR5>(arguments[2], 1.5F, repeat, samples, skip, paths);
    if (robot == "fetch")
        return run<robots::Fetch>(arguments[2], 1.0F, repeat, samples, skip, paths);
    return run<robots::Baxter>(arguments[2], 0.5F, repeat, samples, skip, paths);
}
