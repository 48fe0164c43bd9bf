// What a controller would get, from messages on standard input: one line for each line "now".
//
//   there ID | gone ID | transform ARRIVED_NS PAYLOAD<tab>ATTACHMENT | clock ASKED_NS ANSWERED_NS PAYLOAD | now NS
//
//   c++ -std=c++17 reader.cpp -o reader && ./reader < messages

#include <iostream>
#include <sstream>

#include "reader.hpp"

int main() {
  gripmon::Reader reader(200'000'000);
  std::cout.precision(17);
  for (std::string line; std::getline(std::cin, line);) {
    std::istringstream words(line);
    std::string what, rest;
    gripmon::Ns first = 0, second = 0;
    words >> what;
    if (what == "there" || what == "gone") {
      words >> rest;
      what == "there" ? reader.there(rest) : reader.gone(rest);
      continue;
    }
    words >> first;
    if (what == "clock") words >> second;
    std::getline(words >> std::ws, rest);
    if (what == "transform") {
      const auto tab = rest.find('\t');
      reader.transform(rest.substr(0, tab), tab == std::string::npos ? "" : rest.substr(tab + 1), first);
    } else if (what == "clock") {
      reader.clock(rest, first, second);
    } else if (what == "now") {
      const gripmon::Answer answer = reader.newest(first);
      std::cout << (answer.transform ? "use" : "don't: " + answer.reason);
      if (answer.transform) {
        for (double value : answer.transform->translation_m) std::cout << ' ' << value;
        for (double value : answer.transform->rotation_xyzw) std::cout << ' ' << value;
        std::cout << ' ' << answer.transform->protection_m << ' ' << answer.transform->revision;
      }
      std::cout << std::endl;
    }
  }
}
