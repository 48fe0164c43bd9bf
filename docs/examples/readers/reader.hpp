// May a controller move by the newest transform?  The rules of "Messages on the wire" for a program in C++17.
//
// The messages alone: they come by Zenoh's own C++ library.  Times are all of one steady clock of this process
// that goes on while the machine is suspended (see "How old a transform is"), in ns.  JSON: nlohmann/json.
//
//   gripmon/<robot>/<camera>/alive/*          liveliness subscriber with history: there(id), gone(id); the key's end
//   gripmon/<robot>/<camera>/transform        subscriber, ring of a few: transform(payload, attachment, now)
//   gripmon/<robot>/<camera>/transform?clock  get, once a second, real time and drop: clock(payload, asked, now)
//
// Not for several threads at once: put a mutex around it.

#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <map>
#include <optional>
#include <set>
#include <stdexcept>
#include <string>

#include <nlohmann/json.hpp>

namespace gripmon {

using Ns = std::int64_t;  // a double would round the stamps
using Json = nlohmann::json;

struct Refused : std::runtime_error {
  using std::runtime_error::runtime_error;
};

struct Transform {  // cam_T_grip, gripper to camera: p_cam = R p_grip + t
  std::string verdict, reason, monitor_id, reference_id;
  Ns revision = -1, latency_ns = 0;
  std::array<double, 3> translation_m{};
  std::array<double, 4> rotation_xyzw{};
  double protection_m = 0.0;  // bound on the error of the TCP's position
};

struct Answer {
  const Transform* transform = nullptr;  // until the next call; null: don't move, for this reason
  std::string reason;
};

namespace detail {

constexpr double kMostDrift = 0.001;       // of two steady clocks
constexpr double kUnitTolerance = 1e-3;    // of a quaternion's length
constexpr std::size_t kClocksKept = 16;    // a stranger may make up any number
constexpr std::uint64_t kLargestNs = 1ull << 61;  // 73 years: sums of three stay within 64 bits

inline Json message(const std::string& payload, const std::string& schema) {
  Json json = Json::parse(payload);
  if (!json.is_object() || json.value("schema", Json(schema)) != schema) throw Refused("not " + schema);
  return json;
}

// get<Ns>() would also round 1.5 and wrap 2^63, get<double>() take true for 1.
inline Ns whole(const Json& json, const char* name) {
  const Json& value = json.at(name);
  if (!value.is_number_unsigned() || value.get<std::uint64_t>() > kLargestNs)
    throw Refused(std::string(name) + " is no time or count");
  return static_cast<Ns>(value.get<std::uint64_t>());
}

inline double number(const Json& value) {
  if (!value.is_number()) throw Refused("no number but " + value.dump());
  return value.get<double>();
}

template <std::size_t N>
std::array<double, N> numbers(const Json& values) {
  std::array<double, N> out{};
  if (!values.is_array() || values.size() != N) throw Refused("a transform that is not a pose");
  for (std::size_t k = 0; k < N; ++k) out[k] = number(values[k]);
  return out;
}

inline std::string text(const Json& json, const char* name) {
  return json.contains(name) && json[name].is_string() ? json[name].get<std::string>() : "";
}

inline Transform read(const std::string& payload) {
  const Json json = message(payload, "gripmon.transform/2");
  Transform out;
  out.verdict = json.at("verdict").get<std::string>();
  out.reason = text(json, "reason");
  out.monitor_id = text(json, "monitor_id");
  out.reference_id = json.at("reference_id").get<std::string>();
  out.revision = whole(json, "revision");
  out.latency_ns = whole(json, "latency_ns");
  if (out.verdict != "valid" && out.verdict != "suspect") return out;  // the closed enumeration: all else is unknown
  const Json& pose = json.at("cam_T_grip");
  out.translation_m = numbers<3>(pose.at("translation_m"));
  out.rotation_xyzw = numbers<4>(pose.at("rotation_xyzw"));
  double squares = 0.0;
  for (double each : out.rotation_xyzw) squares += each * each;
  if (!(std::abs(std::sqrt(squares) - 1.0) < kUnitTolerance)) throw Refused("a transform that is not a pose");
  out.protection_m = number(json.at("protection").at("position_m"));
  if (!(out.protection_m >= 0.0)) throw Refused("a protection level below 0");
  return out;
}

}  // namespace detail

class Reader {
 public:
  explicit Reader(Ns max_age_ns) : max_age_ns_(max_age_ns) {}

  void there(const std::string& monitor_id) { there_.insert(monitor_id); }
  void gone(const std::string& monitor_id) { there_.erase(monitor_id); }

  // A message that is none is kept as the reason: what it would have said is not known.
  void transform(const std::string& payload, const std::string& attachment, Ns arrived_ns) {
    try {
      newest_ = detail::read(payload);
      const Json sent = detail::message(attachment, "gripmon.clock/1");
      clock_ = sent.at("clock").get<std::string>();
      sent_ns_ = detail::whole(sent, "now_ns");
      arrived_ns_ = arrived_ns;
      unreadable_.clear();
      const auto lead = leads_.find(clock_);
      if (lead != leads_.end() && arrived_ns + lead->second.at(arrived_ns) < sent_ns_) leads_.erase(lead);  // it jumped
    } catch (const std::exception& error) {
      unreadable_ = error.what();
    }
  }

  // The answer says what the monitor's clock showed after the question: it is ahead of ours by that difference at most.
  void clock(const std::string& payload, Ns asked_ns, Ns answered_ns) {
    try {
      const Json json = detail::message(payload, "gripmon.clock/1");
      const Ns shown_ns = detail::whole(json, "now_ns");
      const Lead first{shown_ns - asked_ns, asked_ns}, lead{first.at(answered_ns), asked_ns};  // it drifted meanwhile
      const auto [known, is_new] = leads_.try_emplace(json.at("clock").get<std::string>(), lead);
      const Ns before_ns = known->second.at(answered_ns);
      if (before_ns < shown_ns - answered_ns || lead.at(answered_ns) < before_ns) known->second = lead;
      if (is_new && leads_.size() > detail::kClocksKept)
        leads_.erase(known == leads_.begin() ? std::next(known) : leads_.begin());
    } catch (const std::exception&) {
      // no answer: what is known grows older
    }
  }

  Answer newest(Ns now_ns) const {
    if (there_.size() > 1) return {nullptr, "two monitors have this name"};
    if (!unreadable_.empty()) return {nullptr, "the last transform can't be read: " + unreadable_};
    if (!newest_) return {nullptr, "no transform came yet"};
    if (there_.count(newest_->monitor_id) == 0) return {nullptr, "its monitor is gone"};
    const bool is_suspect = newest_->verdict == "suspect";
    if (!is_suspect && newest_->verdict != "valid") return {nullptr, "unknown: " + newest_->reason};
    const auto lead = leads_.find(clock_);
    if (lead == leads_.end()) return {nullptr, "its age is not known"};
    const Ns on_its_way_ns = arrived_ns_ + lead->second.at(arrived_ns_) - sent_ns_;
    if (newest_->latency_ns + on_its_way_ns + now_ns - arrived_ns_ > max_age_ns_) return {nullptr, "it is too old"};
    if (is_suspect) return {nullptr, "suspect: " + newest_->reason};
    return {&*newest_, ""};
  }

 private:
  struct Lead {  // the monitor's clock was ahead of ours by most_ns at most, at_ns by ours
    Ns most_ns, at_ns;
    Ns at(Ns when_ns) const {
      return most_ns + static_cast<Ns>(std::ceil(detail::kMostDrift * std::abs(static_cast<double>(when_ns - at_ns))));
    }
  };

  Ns max_age_ns_, arrived_ns_ = 0, sent_ns_ = 0;
  std::set<std::string> there_;
  std::optional<Transform> newest_;
  std::string unreadable_, clock_;
  std::map<std::string, Lead> leads_;
};

}  // namespace gripmon
