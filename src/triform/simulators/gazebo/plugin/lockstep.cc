// A world plugin of Gazebo 11 that runs physics in lock-step with one client.
//
// The client's end of a connected Unix socket is inherited; TRIFORM_GAZEBO_SOCKET is its number. Between two requests
// physics stands still, so results do not depend on how fast either side is. When the connection ends, so does gzserver.

#include <gazebo/common/Events.hh>
#include <gazebo/common/Plugin.hh>
#include <gazebo/physics/physics.hh>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <string>
#include <unordered_map>
#include <vector>

namespace triform {

using gazebo::physics::CollisionPtr;
using ignition::math::Pose3d;
using ignition::math::Vector3d;

constexpr double kInfinity = std::numeric_limits<double>::infinity();

// The wire, in the byte order of the machine that both ends run on. server.py has the same layouts.
enum Operation : uint32_t { kStep = 1, kReset = 2, kPlace = 3 };

// Followed by one row of three doubles for every robot: body twists for kStep, else poses, NaN where a robot is parked.
struct Request {
  uint32_t operation;
  uint32_t steps;     // of physics, before the reply
  uint32_t want_scan;
  uint32_t robot;     // the one that kPlace moves
};

// Followed by one RobotState for every robot and, if wanted, by its ranges, one float for every ray.
struct Reply {
  double time;          // since the last reset [s]
  double min_distance;  // smallest between two centres at any step since the last reply [m]
  uint32_t touched;     // whether two robots touched since the last reply
  uint32_t touched_arena;
};

struct RobotState {
  double x, y, heading;
  double forward, left, turn;  // body twist
};

struct Twist {
  double forward = 0, left = 0, turn = 0;
};

struct Wheel {
  gazebo::physics::JointPtr joint;
  gazebo::physics::LinkPtr link;
  gazebo::physics::FrictionPyramidPtr friction;
  double x, y;   // place in the robot's frame [m]
  double slant;  // +1 or -1: a roller on the ground pulls along (1, slant)
};

struct Robot {
  gazebo::physics::ModelPtr model;
  gazebo::physics::LinkPtr base;
  std::vector<CollisionPtr> collisions;
  std::vector<Wheel> wheels;  // none: planar drive
  bool active = true;
  Twist command, twist;  // twist: what the wheels turn for
};

class LockStep : public gazebo::WorldPlugin {
 public:
  void Load(gazebo::physics::WorldPtr world, sdf::ElementPtr settings) override {
    world_ = world;
    settings_ = settings;
    const char *number = std::getenv("TRIFORM_GAZEBO_SOCKET");
    socket_ = number ? std::atoi(number) : -1;
    dt_ = world->Physics()->GetMaxStepSize();
    begin_ = gazebo::event::Events::ConnectWorldUpdateBegin([this](const auto &) { Begin(); });
    end_ = gazebo::event::Events::ConnectWorldUpdateEnd([this] { Record(); });
  }

 private:
  double Setting(const char *name) const { return settings_->Get<double>(name); }

  // Models are complete only when the first step begins.
  void Prepare() {
    const double lag = Setting("lag");
    gain_ = lag > 0 ? -std::expm1(-dt_ / lag) : 1.0;
    max_change_ = Setting("max_acceleration") * dt_;
    max_turn_change_ = Setting("max_turn_acceleration") * dt_;
    wheel_radius_ = Setting("wheel_radius");
    robots_.resize(settings_->Get<unsigned>("robots"));
    for (size_t i = 0; i < robots_.size(); ++i) FindParts(i);
    world_->Physics()->GetContactManager()->SetNeverDropContacts(true);
    // The solver begins every step anew, so that runs after a reset are the same to the bit.
    world_->Physics()->SetParam("warm_start_factor", 0.0);
    MakeRays();
    values_.resize(3 * robots_.size());
    ready_ = true;
  }

  void FindParts(size_t index) {
    Robot &robot = robots_[index];
    robot.model = world_->ModelByName("robot" + std::to_string(index));
    robot.base = robot.model->GetLink("base");
    for (const auto &link : robot.model->GetLinks())
      for (const auto &collision : link->GetCollisions()) {
        robot.collisions.push_back(collision);
        owners_[collision.get()] = index;
      }
    for (const auto &joint : robot.model->GetJoints()) {
      const auto link = joint->GetChild();
      const Vector3d place = link->RelativePose().Pos();
      robot.wheels.push_back({joint, link, link->GetCollisions()[0]->GetSurface()->FrictionPyramid(), place.X(),
                              place.Y(), place.X() * place.Y() > 0 ? -1.0 : 1.0});
    }
  }

  // One bundle of rays serves all robots in turn: it belongs to the ground, so that its ends are in the world frame.
  void MakeRays() {
    range_min_ = Setting("range_min");
    range_max_ = Setting("range_max");
    lidar_height_ = Setting("lidar_height");
    const auto count = settings_->Get<unsigned>("rays");
    bundle_ = world_->Physics()->CreateCollision("multiray", world_->ModelByName("ground")->GetLink("link"));
    rays_ = boost::dynamic_pointer_cast<gazebo::physics::MultiRayShape>(bundle_->GetShape());
    for (unsigned k = 0; k < count; ++k) {
      const double angle = Setting("angle_min") + 2 * M_PI * k / count;
      ends_.emplace_back(range_max_ * std::cos(angle), range_max_ * std::sin(angle), 0);
      rays_->AddRay(Vector3d::Zero, ends_.back());
    }
  }

  // Before every step of physics: answer and ask until there are steps to take, then drive.
  void Begin() {
    if (!ready_) Prepare();
    while (left_ == 0) {
      if (pending_) Answer();
      Receive(&request_, sizeof request_);
      Receive(values_.data(), values_.size() * sizeof(double));
      Obey();
      left_ = request_.steps;
      pending_ = true;
    }
    --left_;
    for (Robot &robot : robots_)
      if (robot.active) robot.wheels.empty() ? Push(robot) : Roll(robot);
  }

  void Obey() {
    if (request_.operation == kReset) {
      world_->Physics()->SetSeed(1);
      steps_ = 0;
      for (size_t i = 0; i < robots_.size(); ++i) Place(i);
    } else if (request_.operation == kPlace) {
      Place(request_.robot);
    } else {
      for (size_t i = 0; i < robots_.size(); ++i) {
        const double *row = &values_[3 * i];
        robots_[i].command = {row[0], row[1], row[2]};
      }
    }
    if (request_.operation != kStep) Forget();
  }

  // Put a robot down at rest, or below the ground where nothing meets it and it meets nothing.
  void Place(size_t index) {
    Robot &robot = robots_[index];
    const double *pose = &values_[3 * index];
    robot.active = std::isfinite(pose[0]);
    robot.command = robot.twist = {};
    robot.model->Reset();
    const Pose3d place = robot.active ? Pose3d(pose[0], pose[1], 0, 0, 0, pose[2])
                                      : Pose3d(0, 0, -100.0 * (index + 1), 0, 0, 0);
    robot.model->SetWorldPose(place);
    // Moving a model moves its links by a difference of poses; after a reset no bit of the past may be left.
    for (const auto &link : robot.model->GetLinks()) link->SetWorldPose(link->InitialRelativePose() + place);
    robot.model->SetWorldTwist(Vector3d::Zero, Vector3d::Zero);
    robot.model->SetGravityMode(robot.active);
    robot.model->SetEnabled(robot.active);
    Show(robot, robot.active);
  }

  // Let rays and other bodies meet a robot, or pass through it.
  static void Show(const Robot &robot, bool shown) {
    const unsigned bits = shown ? GZ_ALL_COLLIDE : GZ_NONE_COLLIDE;
    for (const auto &collision : robot.collisions) {
      collision->SetCategoryBits(bits);
      collision->SetCollideBits(bits);
    }
  }

  // The heading half a step ago, where the velocity belongs that made this step.
  static double Halfway(const Robot &robot, double turn, double dt) {
    return robot.base->WorldPose().Rot().Yaw() - turn * dt / 2;
  }

  Twist Measured(const Robot &robot) const {
    const Vector3d velocity = robot.base->WorldCoGLinearVel();
    const double turn = robot.base->WorldAngularVel().Z();
    const double heading = Halfway(robot, turn, dt_), c = std::cos(heading), s = std::sin(heading);
    return {c * velocity.X() + s * velocity.Y(), c * velocity.Y() - s * velocity.X(), turn};
  }

  // The body twist one step later: first-order lag with bounded acceleration.
  Twist Steered(const Twist &now, const Twist &command) const {
    double forward = gain_ * (command.forward - now.forward), left = gain_ * (command.left - now.left);
    const double turn = gain_ * (command.turn - now.turn), change = std::hypot(forward, left);
    if (change > max_change_) {
      forward *= max_change_ / change;
      left *= max_change_ / change;
    }
    return {now.forward + forward, now.left + left, now.turn + std::clamp(turn, -max_turn_change_, max_turn_change_)};
  }

  // Planar drive: the force and the torque that make the next body twist, on a ground without friction.
  void Push(Robot &robot) const {
    const Twist next = Steered(Measured(robot), robot.command);
    const double heading = Halfway(robot, -next.turn, dt_), c = std::cos(heading), s = std::sin(heading);
    const Vector3d velocity = robot.base->WorldCoGLinearVel();
    const auto inertial = robot.base->GetInertial();
    const double rate = inertial->Mass() / dt_;
    robot.base->AddForce(Vector3d(rate * (c * next.forward - s * next.left - velocity.X()),
                                  rate * (s * next.forward + c * next.left - velocity.Y()), 0));
    robot.base->AddTorque(
        Vector3d(0, 0, inertial->IZZ() * (next.turn - robot.base->WorldAngularVel().Z()) / dt_));
  }

  // Mecanum drive: turn four wheels whose friction acts along the axis of the roller on the ground.
  void Roll(Robot &robot) const {
    robot.twist = Steered(robot.twist, robot.command);
    const auto turned = robot.base->WorldPose().Rot();
    for (const Wheel &wheel : robot.wheels) {
      const double forward = robot.twist.forward - robot.twist.turn * wheel.y;
      const double left = robot.twist.left + robot.twist.turn * wheel.x;
      wheel.joint->SetParam("fmax", 0, 5.0);
      wheel.joint->SetParam("vel", 0, (forward + wheel.slant * left) / wheel_radius_);
      const Vector3d axis = turned.RotateVector(Vector3d(1, wheel.slant, 0).Normalized());
      wheel.friction->direction1 = wheel.link->WorldPose().Rot().RotateVectorReverse(axis);
    }
  }

  // After every step: distances and contacts.
  void Record() {
    ++steps_;
    Approach();
    const auto contacts = world_->Physics()->GetContactManager();
    for (unsigned k = 0; k < contacts->GetContactCount(); ++k) {
      const auto *contact = contacts->GetContact(k);
      const auto first = owners_.find(contact->collision1), second = owners_.find(contact->collision2);
      if (first != owners_.end() && second != owners_.end())
        touched_ = true;
      else if (contact->collision1->GetModel()->GetName() != "ground" &&
               contact->collision2->GetModel()->GetName() != "ground")
        touched_arena_ = true;
    }
  }

  void Approach() {
    for (size_t i = 0; i < robots_.size(); ++i)
      for (size_t j = 0; j < i; ++j)
        if (robots_[i].active && robots_[j].active) {
          const Vector3d apart = robots_[i].base->WorldPose().Pos() - robots_[j].base->WorldPose().Pos();
          min_distance_ = std::min(min_distance_, std::hypot(apart.X(), apart.Y()));
        }
  }

  void Forget() {
    min_distance_ = kInfinity;
    touched_ = touched_arena_ = false;
    Approach();
  }

  void Answer() {
    const size_t row = sizeof(RobotState), ray = request_.want_scan ? sizeof(float) : 0;
    reply_.resize(sizeof(Reply) + robots_.size() * (row + ray * ends_.size()));
    char *out = reply_.data();
    const Reply head{steps_ * dt_, min_distance_, touched_, touched_arena_};
    out = static_cast<char *>(std::memcpy(out, &head, sizeof head)) + sizeof head;
    for (const Robot &robot : robots_) {
      const Pose3d pose = robot.base->WorldPose();
      const Twist twist = Measured(robot);
      const RobotState state{pose.Pos().X(), pose.Pos().Y(), pose.Rot().Yaw(), twist.forward, twist.left, twist.turn};
      out = static_cast<char *>(std::memcpy(out, &state, row)) + row;
    }
    if (request_.want_scan)
      for (const Robot &robot : robots_) {
        Scan(robot, reinterpret_cast<float *>(out));
        out += ray * ends_.size();
      }
    Send();
    Forget();
    pending_ = false;
  }

  void Scan(const Robot &robot, float *ranges) const {
    std::fill_n(ranges, ends_.size(), kInfinity);
    if (!robot.active) return;
    Show(robot, false);  // Nobody sees its own body.
    const Pose3d lidar = Pose3d(0, 0, lidar_height_, 0, 0, 0) + robot.base->WorldPose();
    for (size_t k = 0; k < ends_.size(); ++k) {
      rays_->Ray(k)->SetPoints(lidar.Pos(), lidar.CoordPositionAdd(ends_[k]));
      rays_->Ray(k)->SetLength(range_max_);
    }
    rays_->UpdateRays();
    for (size_t k = 0; k < ends_.size(); ++k) {
      const double range = rays_->Ray(k)->GetLength();
      if (range < range_max_) ranges[k] = range < range_min_ ? -kInfinity : range;
    }
    Show(robot, true);
  }

  // Physics belongs to the client: without it there is nothing left to do.
  void Receive(void *data, size_t size) const {
    for (char *place = static_cast<char *>(data); size > 0;) {
      const ssize_t got = recv(socket_, place, size, 0);
      if (got <= 0) _exit(0);
      place += got;
      size -= got;
    }
  }

  void Send() const {
    const char *place = reply_.data();
    for (size_t size = reply_.size(); size > 0;) {
      const ssize_t sent = send(socket_, place, size, MSG_NOSIGNAL);
      if (sent <= 0) _exit(0);
      place += sent;
      size -= sent;
    }
  }

  gazebo::physics::WorldPtr world_;
  sdf::ElementPtr settings_;
  gazebo::event::ConnectionPtr begin_, end_;
  int socket_ = -1;
  bool ready_ = false;

  std::vector<Robot> robots_;
  std::unordered_map<const gazebo::physics::Collision *, size_t> owners_;
  CollisionPtr bundle_;
  gazebo::physics::MultiRayShapePtr rays_;
  std::vector<Vector3d> ends_;  // of the rays, in the frame of the LiDAR
  double dt_ = 0, gain_ = 1, max_change_ = 0, max_turn_change_ = 0, wheel_radius_ = 0;
  double range_min_ = 0, range_max_ = 0, lidar_height_ = 0;

  Request request_{};
  std::vector<double> values_;
  std::vector<char> reply_;
  bool pending_ = false;  // a request waits for its reply
  uint32_t left_ = 0;     // steps to take before it
  uint64_t steps_ = 0;
  double min_distance_ = kInfinity;
  bool touched_ = false, touched_arena_ = false;
};

GZ_REGISTER_WORLD_PLUGIN(LockStep)

}  // namespace triform
